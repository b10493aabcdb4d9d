"""How a recorded session's attempts were judged, by the program and by people, and a word added once it is closed.

Called by `far mark` and by the attempt view of `far replay`.
"""

from __future__ import annotations

from dataclasses import replace

from far_app.errors import ConfigError
from far_app.marks import Judged, Mark, Verdict
from far_app.recording import marks
from far_app.recording.reader import SessionRecording


def judged(session: SessionRecording) -> dict[tuple[int, int], Judged]:
    """(trial, attempt) of every attempt that ended: the program's judgment, people's last word beside it."""
    found: dict[tuple[int, int], Judged] = {}
    for entry in session.log:
        key, detail = (entry.trial, entry.attempt), entry.detail
        if entry.event == "attempt_ended":
            found[key] = Judged(
                trial=entry.trial, attempt=entry.attempt, success=bool(detail.get("success")),
                judged_by=str(detail.get("judged_by", "")),
            )  # fmt: skip
        elif entry.event == "outcome_marked" and key in found:  # Mark success, while the program learnt from it
            verdict = Verdict.SUCCESS if detail.get("success") else Verdict.FAILURE
            found[key] = replace(found[key], verdict=verdict, note=str(detail.get("note", "")))
    for word in session.words:
        before = found.get((word.trial, word.attempt))
        if before is not None:
            found[word.trial, word.attempt] = replace(
                before, verdict=word.verdict or before.verdict, note=word.note or before.note,
                by=word.by or before.by,
            )  # fmt: skip
    return found


def mark_closed(session: SessionRecording, mark: Mark) -> Judged:
    """Keep a word on an attempt of a session that is over; on the disk when it returns. The attempt as judged before.

    Raises ConfigError when the session is still recorded or has no such attempt, RecordingError when it cannot be kept.
    """
    if session.live:
        raise ConfigError(f"{session.path} is still being recorded; mark its attempts on its page")
    known = judged(session)
    before = known.get((mark.trial, mark.attempt))
    if before is None:
        there = ", ".join(f"{t}.{a}" for t, a in known) or "none"
        raise ConfigError(
            f"{session.path} has no ended attempt {mark.attempt} of trial {mark.trial}; it has (trial.attempt) {there}"
        )
    marks.append(session.path, mark)
    return before
