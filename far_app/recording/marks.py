"""People's words on attempts, as they are kept: lines of trials.jsonl while the session runs ("attempt_marked"), of
marks.jsonl beside it afterwards, in the same form.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from far_app.errors import RecordingError
from far_app.marks import Mark, Verdict, trouble
from far_app.recording.said_lines import append_line, now
from far_app.recording.schema import LogEntry

MARKS_FILE = "marks.jsonl"
EVENT = "attempt_marked"


def detail(mark: Mark) -> dict[str, object]:
    """What a line carries."""
    return {
        "trial": mark.trial, "attempt": mark.attempt, "verdict": mark.verdict or "", "note": mark.note, "by": mark.by,
    }  # fmt: skip


def append(session: Path, mark: Mark) -> None:
    """Add a word to a session that is closed; on the disk when it returns. Raises RecordingError."""
    if why := trouble(mark):
        raise RecordingError(why)
    append_line(
        session / MARKS_FILE,
        LogEntry(
            event=EVENT, stamp=time.monotonic(), wall=mark.wall or now(), trial=mark.trial, attempt=mark.attempt,
            text=mark.note, detail=detail(mark),
        ),
    )  # fmt: skip


def marks_in(lines: Sequence[LogEntry]) -> tuple[list[Mark], list[str]]:
    """The words among a session's lines, oldest first, and what of them cannot be read."""
    found, problems = [], []
    for entry in lines:
        if entry.event != EVENT:
            continue
        d = entry.detail
        try:
            verdict = Verdict(d["verdict"]) if d["verdict"] else None
            mark = Mark(
                trial=int(d["trial"]), attempt=int(d["attempt"]), verdict=verdict, note=str(d.get("note", "")),
                by=str(d.get("by", "")), wall=entry.wall,
            )  # fmt: skip
        except (KeyError, TypeError, ValueError) as error:
            problems.append(f"a mark of {entry.wall} is damaged: {error!r}")
            continue
        found.append(mark)
    return found, problems
