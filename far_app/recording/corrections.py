"""The operator's words on chunks: to blame or not, by whom, when. Append-only; a recording is never rewritten.

Words said during a session are lines of its trials.jsonl ("flag_corrected"); those said afterwards go to
corrections.jsonl beside it, one line each, in the same form. Called by `far replay` and the attempt view.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from far_app.recording.reader import SessionRecording
from far_app.recording.said_lines import append_line, now, read_lines
from far_app.recording.schema import LogEntry
from far_app.types import FlagCorrection

CORRECTIONS_FILE = "corrections.jsonl"
EVENT = "flag_corrected"

Corrections = dict[tuple[int, int], tuple[FlagCorrection, ...]]
"""(trial, attempt) to the words on its chunks, oldest first."""


@dataclass(frozen=True, kw_only=True)
class Word:
    """One correction and the attempt it is on."""

    trial: int
    attempt: int
    correction: FlagCorrection


def detail(word: Word, used: bool) -> dict[str, object]:
    """What a line of trials.jsonl or corrections.jsonl carries."""
    c = word.correction
    return {
        "trial": word.trial, "attempt": word.attempt, "tick": c.tick, "flagged": c.flagged, "by": c.by, "used": used,
    }  # fmt: skip


def append(session: Path, word: Word) -> None:
    """Add a word to a closed session's corrections; on the disk when it returns. Raises RecordingError."""
    entry = LogEntry(
        event=EVENT, stamp=time.monotonic(), wall=word.correction.wall or now(), trial=word.trial,
        attempt=word.attempt, detail=detail(word, used=False),
    )  # fmt: skip
    append_line(session / CORRECTIONS_FILE, entry)


def corrections(session: SessionRecording) -> tuple[Corrections, list[str]]:
    """Every word on this session's chunks, and what of them cannot be read."""
    words, problems = {}, []
    after, cut = read_lines(session.path / CORRECTIONS_FILE)
    for entry in [*(e for e in session.log if e.event == EVENT), *after]:
        d = entry.detail
        try:
            key = int(d["trial"]), int(d["attempt"])
            word = FlagCorrection(
                tick=int(d["tick"]), flagged=bool(d["flagged"]), by=str(d.get("by", "")), wall=entry.wall
            )
        except (KeyError, TypeError, ValueError) as error:
            problems.append(f"a correction of {entry.wall} is damaged: {error!r}")
            continue
        words[key] = (*words.get(key, ()), word)
    return words, [*problems, *cut]
