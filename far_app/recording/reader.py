"""A session's folder as typed values again. Tolerant of crashes and damage: says what is missing, repairs nothing.

Called by inspect, replay, exports and the operator's views.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from far_app.errors import RecordingError
from far_app.marks import Mark, Verdict
from far_app.recording.append_file import being_written
from far_app.recording.attempt_reader import AttemptRecording, read_attempt
from far_app.recording.codec import decode
from far_app.recording.marks import MARKS_FILE, marks_in
from far_app.recording.migrations import migrated, readable
from far_app.recording.said_lines import read_lines
from far_app.recording.schema import (
    SCHEMA_NAME,
    SESSION_FILE,
    TRIALS_FILE,
    LogEntry,
    SessionHeader,
)
from far_app.types import (
    Judge,
    Outcome,
)


@dataclass(frozen=True, kw_only=True)
class SessionRecording:
    """One session's folder. Attempts' files are read when asked for."""

    path: Path
    header: SessionHeader
    log: tuple[LogEntry, ...]
    """trials.jsonl."""
    files: tuple[Path, ...]
    """Attempts' files, in order of trial and attempt."""
    live: bool
    """A living process is still writing."""
    problems: tuple[str, ...]
    words: tuple[Mark, ...] = ()
    """People's words on attempts, oldest first, those said after the session was closed included."""

    def attempts(self) -> Iterator[AttemptRecording]:
        """Every attempt, one at a time."""
        for file in self.files:
            yield read_attempt(file)

    @cached_property
    def marks(self) -> dict[tuple[int, int], Outcome]:
        """(trial, attempt) to the last verdict on it, those given after its file was closed included; being unsure
        changes none (see `unsure`)."""
        words = {}
        for entry in self.log:
            if entry.event in ("attempt_ended", "outcome_marked"):
                known = {key: entry.detail.get(key) for key in ("success", "judged_by", "note")}
                words[entry.trial, entry.attempt] = decode(Outcome, known, f"{self.path / TRIALS_FILE}: {entry.event}")
        for word in self.words:
            if word.verdict in (Verdict.SUCCESS, Verdict.FAILURE):
                words[word.trial, word.attempt] = Outcome(
                    success=word.verdict is Verdict.SUCCESS, judged_by=Judge.OPERATOR, note=word.note
                )
        return words

    @cached_property
    def unsure(self) -> frozenset[tuple[int, int]]:
        """(trial, attempt) of which a person said last that it is not sure how it went."""
        last = {(word.trial, word.attempt): word.verdict for word in self.words if word.verdict is not None}
        return frozenset(key for key, verdict in last.items() if verdict is Verdict.UNSURE)


def read_session(path: Path) -> SessionRecording:
    """Raises RecordingError when the folder holds no session or one of another schema."""
    header = _read_header(path)
    log, problems = _read_log(path / TRIALS_FILE, header.schema_version)
    afterwards, cut = read_lines(path / MARKS_FILE)
    words, damaged = marks_in([*log, *afterwards])
    return SessionRecording(
        path=path, header=header, log=tuple(log), files=tuple(sorted(path.glob("trial_*/attempt_*.mcap"), key=_order)),
        live=being_written(path / TRIALS_FILE), problems=(*problems, *cut, *damaged), words=tuple(words),
    )  # fmt: skip


def _read_header(path: Path) -> SessionHeader:
    file = path / SESSION_FILE
    try:
        body = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RecordingError(f"{path} holds no session: there is no {SESSION_FILE}; give a session's folder") from None
    except (OSError, ValueError) as error:
        raise RecordingError(f"{file} cannot be read: {error}") from error
    if not isinstance(body, dict) or body.get("schema") != SCHEMA_NAME:
        raise RecordingError(f"{file} is not a recording of this program (schema is not '{SCHEMA_NAME}')")
    version = readable(body.get("schema_version"), path)
    return decode(SessionHeader, migrated(SESSION_FILE, body, version), str(file))


def _read_log(file: Path, version: int) -> tuple[list[LogEntry], list[str]]:
    try:
        lines = file.read_bytes().split(b"\n")
    except OSError as error:
        return [], [f"{file.name} cannot be read: {error.strerror}"]
    problems = [f"the last line of {file.name} was cut off ({len(lines[-1])} bytes)"] if lines[-1] else []
    entries = []
    for number, line in enumerate(lines[:-1], start=1):
        try:
            entries.append(decode(LogEntry, migrated(TRIALS_FILE, json.loads(line), version), file.name))
        except (ValueError, KeyError, TypeError, AttributeError, RecordingError) as error:
            problems.append(f"line {number} of {file.name} is damaged: {error}")
    return entries, problems


def _order(file: Path) -> tuple[int, int, str]:
    trial, attempt = file.parent.name.removeprefix("trial_"), file.stem.removeprefix("attempt_")
    return (int(trial) if trial.isdigit() else 0, int(attempt) if attempt.isdigit() else 0, str(file))
