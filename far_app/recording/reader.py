"""Recordings as typed values again. Tolerant of crashes and damage: says what is missing, repairs nothing.

Called by inspect, replay, exports and the operator's views.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Message

from far_app.errors import RecordingError
from far_app.marks import Mark, Verdict
from far_app.recording.append_file import being_written
from far_app.recording.codec import Json, decode
from far_app.recording.images import LazyImages, decode_png
from far_app.recording.marks import MARKS_FILE, marks_in
from far_app.recording.migrations import migrated, readable
from far_app.recording.said_lines import read_lines
from far_app.recording.scan import Scan, scan
from far_app.recording.schema import (
    CAMERA_TOPIC,
    SCHEMA_NAME,
    SCHEMA_VERSION,
    SESSION_FILE,
    TRIALS_FILE,
    AttemptHeader,
    LogEntry,
    RecordedEvent,
    SessionHeader,
)
from far_app.types import (
    ActionChunk,
    Adaptation,
    AdaptationStep,
    Attempt,
    Judge,
    Observation,
    Outcome,
    Step,
    TickTimes,
)


@dataclass(frozen=True, kw_only=True)
class AttemptRecording:
    """One attempt's file."""

    path: Path
    header: AttemptHeader | None
    """None when the file was cut off before it or it is damaged."""
    steps: tuple[Step, ...]
    """In the order of their ticks; frames are decoded when asked for."""
    chunks: tuple[ActionChunk, ...]
    tick_times: tuple[TickTimes, ...]
    """Where each tick's time went; empty in older recordings."""
    events: tuple[RecordedEvent, ...]
    final: Observation | None
    outcomes: tuple[Outcome, ...]
    """The program's own judgment first, then the marks made while the file was open."""
    adaptation_steps: tuple[AdaptationStep, ...]
    adaptation: Adaptation | None
    frames: dict[str, int]
    """Camera name to the number of readable frames."""
    abandoned: str
    """Why the attempt ended without an outcome (skipped, quit, recording failed); "" when it was not abandoned."""
    closed: bool
    """The writer finished the file."""
    damaged: bool
    """Bytes are there that cannot be trusted, beyond a torn end."""
    problems: tuple[str, ...]
    """What is missing or damaged, in words."""
    size: int
    """Bytes."""

    @property
    def outcome(self) -> Outcome | None:
        """The last word."""
        return self.outcomes[-1] if self.outcomes else None

    @property
    def duration(self) -> float:
        """Seconds from the first step's observation to the final one (or to the last step's)."""
        if not self.steps:
            return 0.0
        last = self.final.stamp if self.final is not None else self.steps[-1].stamp
        return last - self.steps[0].stamp

    def attempt(self) -> Attempt:
        """The value the loop handed over. Raises RecordingError when it never ended."""
        if self.header is None or self.final is None or self.outcome is None:
            why = "; ".join(self.problems) or f"it was abandoned: {self.abandoned}"
            raise RecordingError(f"{self.path} holds no ended attempt: {why}")
        return Attempt(
            index=self.header.attempt, scene_seed=self.header.scene_seed, steps=self.steps, final=self.final,
            outcome=self.outcome, policy_version=self.header.policy_version,
        )  # fmt: skip


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


def read_attempt(path: Path) -> AttemptRecording:
    """Raises RecordingError when there is no such file, it is not MCAP, or it is of another schema."""
    found = scan(path)
    parts = _Parts(path, found)
    return parts.recording()


@dataclass
class _Parts:
    """What the messages of one file amount to."""

    path: Path
    found: Scan
    header: AttemptHeader | None = None
    problems: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.problems.extend(self.found.problems)
        self._unreadable = 0
        self._by_topic: dict[str, list[Message]] = {}
        for topic, message in self.found.messages:
            self._by_topic.setdefault(topic, []).append(message)
        self._version = SCHEMA_VERSION  # of a file whose header is lost: what it lacks reads as the defaults
        for body in self._bodies("/attempt"):
            if isinstance(body, dict) and "schema_version" in body:
                self._version = readable(body["schema_version"], self.path)
                break
        headers = self._values("/attempt", AttemptHeader)
        self.header = headers[0] if headers else None
        self._frames = {
            topic.removeprefix(CAMERA_TOPIC): {message.sequence: message.data for message in messages}
            for topic, messages in self._by_topic.items()
            if topic.startswith(CAMERA_TOPIC)
        }
        self._missing_frames = 0

    def recording(self) -> AttemptRecording:
        steps = [self._step(message) for message in self._by_topic.get("/step", [])]
        steps = sorted((step for step in steps if step is not None), key=lambda step: step.tick)
        finals = [final for body in self._bodies("/final") if (final := self._observation(body)) is not None]
        outcomes = self._values("/outcome", Outcome)
        adaptations = self._values("/adaptation", Adaptation)
        chunks = self._values("/chunk", ActionChunk)
        times = self._values("/tick_times", TickTimes)
        events = self._values("/event", RecordedEvent)
        progress = self._values("/adaptation_step", AdaptationStep)
        abandonments = [event.text for event in events if event.event in ("attempt_abandoned", "recording_failed")]
        self._say_what_is_missing(steps, finals, outcomes, abandoned=bool(abandonments))
        return AttemptRecording(
            path=self.path, header=self.header, steps=tuple(steps), chunks=tuple(chunks), tick_times=tuple(times),
            events=tuple(events), final=finals[-1] if finals else None, outcomes=tuple(outcomes),
            adaptation_steps=tuple(progress), adaptation=adaptations[-1] if adaptations else None,
            abandoned=abandonments[-1] if abandonments else "",
            frames={camera: len(frames) for camera, frames in self._frames.items()}, closed=self.found.closed,
            damaged=self.found.damaged or self._unreadable > 0, problems=tuple(self.problems), size=self.found.size,
        )  # fmt: skip

    def _say_what_is_missing(
        self,
        steps: list[Step],
        finals: list[Observation],
        outcomes: list[Outcome],
        abandoned: bool,
    ) -> None:
        say = self.problems.append
        if self.header is None:
            say("the header is missing")
        gaps = sorted(set(range(steps[-1].tick + 1)) - {step.tick for step in steps}) if steps else []
        if gaps:
            say(f"{len(gaps)} steps are missing: ticks {_ranges(gaps)}")
        if self._missing_frames:
            say(f"{self._missing_frames} frames that steps refer to are missing")
        if self._unreadable:
            say(f"{self._unreadable} messages do not fit their schema")
        if not outcomes and not abandoned:
            say("the outcome is missing: the attempt was cut off")
        elif outcomes and not finals:
            say("the final observation is missing")
        if not self.found.closed:
            say("the file was not closed")

    def _bodies(self, topic: str) -> list[Json]:
        bodies = []
        for message in self._by_topic.get(topic, []):
            try:
                bodies.append(migrated(topic, json.loads(message.data), self._version))
            except (ValueError, KeyError, TypeError, AttributeError):
                self._unreadable += 1
        return bodies

    def _values(self, topic: str, record: Any) -> list[Any]:
        values = []
        for body in self._bodies(topic):
            try:
                values.append(decode(record, body, f"{self.path} {topic}"))
            except RecordingError:
                self._unreadable += 1
        return values

    def _step(self, message: Message) -> Step | None:
        what = f"{self.path} /step {message.sequence}"
        try:
            body = migrated("/step", json.loads(message.data), self._version)
            images = self._images(body["observation"].pop("frames"))
            step = decode(Step, body, what)
        except (ValueError, KeyError, TypeError, AttributeError, RecordingError):
            self._unreadable += 1
            return None
        return replace(step, observation=replace(step.observation, images=images))

    def _observation(self, body: Json) -> Observation | None:
        try:
            images = self._images(body.pop("frames"))
            return replace(decode(Observation, body, f"{self.path} /final"), images=images)
        except (KeyError, TypeError, AttributeError, RecordingError):
            self._unreadable += 1
            return None

    def _images(self, numbers: dict[str, int]) -> LazyImages:
        available: dict[str, Callable[[], np.ndarray]] = {}
        for camera, number in numbers.items():
            message = self._frames.get(camera, {}).get(number)
            if message is None:
                self._missing_frames += 1
            else:
                available[camera] = partial(_decode_frame, message)
        return LazyImages(available)


def _decode_frame(message: bytes) -> np.ndarray:
    return decode_png(base64.b64decode(json.loads(message)["data"]))


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


def _ranges(ticks: list[int]) -> str:
    """3, 4, 5, 9 as "3–5, 9"."""
    spans: list[list[int]] = []
    for tick in ticks:
        if spans and tick == spans[-1][1] + 1:
            spans[-1][1] = tick
        else:
            spans.append([tick, tick])
    return ", ".join(str(a) if a == b else f"{a}–{b}" for a, b in spans)
