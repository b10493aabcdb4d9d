"""Whole small sessions for the recorder's tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from far_app.recording.schema import SessionInfo
from far_app.recording.writer import SessionWriter

from . import values

INFO = SessionInfo(
    task="lift", method="far", config={"retry": {"fcpa": {"lr": 1e-5}}}, rig={"arm": "twin"}, policy="quickstart",
    cameras=values.CAMERAS, seed=3,
)  # fmt: skip


def open_writer(root: Path, **settings: Any) -> SessionWriter:
    """A writer that does not mind how little room a test machine has."""
    return SessionWriter(root, INFO, **{"space_to_start": 0, "space_to_go_on": 0, **settings})


def small_session(root: Path, *, steps: int = 12) -> Path:
    """One trial: a failed attempt with its adaptation, a retry that succeeds."""
    writer = open_writer(root)
    writer.begin_trial(1, 7)
    writer.begin_attempt(1, "base")
    for tick in range(steps):
        writer.add_chunk(values.chunk(tick))
    writer.end_attempt(values.attempt(1, steps))
    writer.add_adaptation(values.adaptation(steps))
    writer.begin_attempt(2, "base+1")
    writer.end_attempt(values.attempt(2, steps, start=2000.0, success=True))
    writer.end_trial(success=True, attempts=2)
    writer.close()
    return writer.folder
