"""Chosen attempts as rerun files, one each, in one folder. The drawing is the operator interface's: it is handed in."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from far_app.errors import ConfigError
from far_app.exchange.select import Chosen
from far_app.exchange.target import whole
from far_app.recording.attempt_reader import AttemptRecording
from far_app.recording.replay import WriteRrd


def write_rrds(path: Path, attempts: Iterable[Chosen], write_rrd: WriteRrd, overwrite: bool) -> int:
    """SESSION_trial_0001_attempt_1.rrd, …; how many. A segment's file holds the steps from its first tick on."""
    count = 0
    with whole(path, overwrite) as half:
        half.mkdir()
        for one in attempts:
            header = one.recording.header
            assert header is not None
            name = f"{one.session.header.session}_trial_{header.trial:04d}_attempt_{header.attempt}.rrd"
            write_rrd(from_tick(one.recording, one.first), half / name)
            count += 1
        if not count:
            raise ConfigError("no attempt to export; far inspect lists what the sessions hold, --only filters it")
    return count


def from_tick(recording: AttemptRecording, first: int) -> AttemptRecording:
    """The same without its first steps; what was learnt from it moves along, for it counts from the first step."""
    lesson = recording.adaptation
    if lesson is not None:
        lesson = replace(
            lesson, values=lesson.values[first:], value_changes=lesson.value_changes[first:],
            flagged=tuple(tick - first for tick in lesson.flagged if tick >= first),
        )  # fmt: skip
    return replace(recording, steps=recording.steps[first:], adaptation=lesson) if first else recording
