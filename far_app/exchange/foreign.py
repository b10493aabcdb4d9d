"""Demonstrations made elsewhere, as ours: what of theirs becomes what of ours, and what cannot.

A policy here needs pictures of named cameras, the hand's pose and gripper opening (8 numbers), and 7 actions in
[−1, 1]. Whatever else a file holds is not used; what is used is said line by line before anything is written.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from far_app.errors import ConfigError, RecordingError
from far_app.picture import Framing, seen
from far_app.types import ACTION_DIM

FIRST_SCENE = 2_000_000
"""Episodes that know no scene are numbered from here, apart from every scene of this program."""
PANDA_OPEN = 0.08
"""Metres between a Panda's fingers when open; robosuite's gripper_qpos holds half of it for each."""


@dataclass(frozen=True, kw_only=True)
class Foreign:
    """How to read a file of another program's."""

    cameras: Mapping[str, str] = field(default_factory=dict)
    """Our camera's name to the file's key; found by the usual names when empty."""
    gripper: tuple[float, float] | None = None
    """The file's gripper reading when closed and when open; needed where the gripper is not known."""
    image_size: int | None = None
    """Pixels to cut and scale pictures to; whole and as they are by default."""


def cameras(wanted: Mapping[str, str], known: Mapping[str, Sequence[str]], there: Sequence[str]) -> dict[str, str]:
    """Our camera to their key. Raises ConfigError when a named one is not there, or none can be found."""
    missing = [key for key in wanted.values() if key not in there]
    if missing:
        raise ConfigError(f"no pictures {', '.join(missing)} in the file; it has {', '.join(there) or 'none'}")
    found = dict(wanted) or {
        ours: next(k for k in keys if k in there) for ours, keys in known.items() if set(keys) & set(there)
    }
    if there and not found:
        raise ConfigError(
            f"which camera is which? the file has {', '.join(there)}; name them: --cameras front={there[0]}"
        )
    return found


def opening(reading: np.ndarray, limits: tuple[float, float] | None, what: str) -> np.ndarray:
    """(N, 1), 0 closed to 1 open, from a gripper's reading: a width, one joint, or two opposed fingers. Raises
    ConfigError when it cannot be told."""
    rows = reading.reshape(len(reading), -1).astype(np.float64)
    width = rows[:, 0] - rows[:, 1] if rows.shape[1] == 2 else rows[:, 0]
    if limits is None:
        raise ConfigError(
            f"{what}: how far open is {rows[0].round(4).tolist()}? give the reading when closed and when open, for a "
            f"Panda --gripper 0 {PANDA_OPEN}"
        )
    closed, opened = limits
    if closed == opened:
        raise ConfigError(f"--gripper is {closed:g} {opened:g}; closed and open must differ")
    return np.clip((width - closed) / (opened - closed), 0.0, 1.0)[:, None].astype(np.float32)


def actions(rows: np.ndarray, what: str) -> np.ndarray:
    """Checked. Raises ConfigError for another action space."""
    if rows.ndim != 2 or rows.shape[1] != ACTION_DIM:
        raise ConfigError(
            f"{what} are of shape {rows.shape[1:]}, {ACTION_DIM} are needed: hand translation (3), rotation (3) and "
            "gripper, each in [−1, 1]; joint targets and two arms cannot be imported"
        )
    largest = float(np.abs(rows).max(initial=0.0))
    if not largest <= 1.0 + 1e-5:
        raise ConfigError(f"{what} reach {largest:.3g}, must be in [−1, 1]: they are not normalised deltas of the hand")
    return rows.astype(np.float32)


def pictures(frames: np.ndarray, size: int | None, what: str) -> np.ndarray:
    """uint8 N × H × W × 3; where asked, the picture of that size that a policy would see of each."""
    if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[3] != 3:
        raise RecordingError(f"{what} holds {frames.dtype} {frames.shape}; pictures are uint8 N × H × W × 3")
    return frames if size is None else np.stack([seen(frame, Framing(), size) for frame in frames])


def unused(there: Iterable[str], used: Iterable[str]) -> list[str]:
    """A line on what is passed over."""
    left = sorted(set(there) - set(used))
    return [f"not used: {', '.join(left)}"] if left else []
