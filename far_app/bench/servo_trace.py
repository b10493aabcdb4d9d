"""The servo targets that the fake controller received, as a path: how large its steps are, when it stood still."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hw.safety import SafetyLimits

MOVED = 0.02
"""Millimetres between two servo targets that count as motion."""
STILL = 0.06
"""Seconds without motion that count as a hold on the wire."""
EDGE = 0.1
"""Millimetres outside the box that rounding on the wire may make."""


@dataclass(frozen=True, kw_only=True)
class ServoTrace:
    """Millimetres and monotonic seconds."""

    first: np.ndarray
    """The first target; NaN without any."""
    largest_step: float
    """Between two targets in a row."""
    way: float
    last_motion: float
    """When the last target that moved was received; 0 when none did."""
    stills: int
    """Times that it moved again after standing still."""
    step_after_still: float
    """The largest first step of those."""
    outside: int
    """Targets outside the workspace box."""


def servo_trace(targets: Sequence[dict[str, Any]], safety: SafetyLimits) -> ServoTrace:
    """Of hw.fake_xarm.control.FakeXArm.servo_targets()."""
    path = np.array([t["pose"][:3] for t in targets]).reshape(-1, 3)
    at = np.array([t["at"] for t in targets])
    size = np.linalg.norm(np.diff(path, axis=0), axis=1)
    moves = np.flatnonzero(size > MOVED)
    moved = at[1:][moves]
    again = moves[1:][np.diff(moved) > STILL]
    low, high = np.array(safety.box_min) * 1e3 - EDGE, np.array(safety.box_max) * 1e3 + EDGE
    return ServoTrace(
        first=path[0] if len(path) else np.full(3, np.nan), largest_step=round(float(size.max(initial=0.0)), 3),
        way=float(size.sum()), last_motion=float(moved[-1]) if len(moved) else 0.0, stills=len(again),
        step_after_still=round(float(size[again].max(initial=0.0)), 3),
        outside=int(((path < low) | (path > high)).any(axis=1).sum()),
    )  # fmt: skip
