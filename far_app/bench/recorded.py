"""How much of what came before an event a recording holds, for benchmarks that strike a session."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from far_app.recording.attempt_reader import AttemptRecording
from far_app.recording.reader import read_session


def attempts_in(recordings: Path) -> list[AttemptRecording]:
    """Of the one session in a folder."""
    (folder,) = recordings.iterdir()
    return list(read_session(folder).attempts())


def lacking(attempts: Iterable[AttemptRecording], event: float) -> float | None:
    """Seconds between the newest recorded tick before an event (monotonic seconds) and the event, where every tick of
    that attempt before it is there; None where one is not. A tick lasts 0.033 s, so up to two of them lack nothing: one
    runs, one's acknowledgment is on its way."""
    before = [(a, [s for s in a.steps if s.deadline <= event]) for a in attempts]
    newest = max(((steps[-1].deadline, a, steps) for a, steps in before if steps), default=None, key=lambda x: x[0])
    if newest is None:
        return None
    deadline, _, steps = newest
    whole = [step.tick for step in steps] == list(range(len(steps)))
    return event - deadline if whole else None
