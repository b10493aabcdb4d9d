"""What the controller tells by itself: pose, joints, state and mode a hundred times a second, errors five times.

Two connections, because the fast report carries no error code. Nobody asks for the error code on the one whose error
callback is used: a question would keep the callback from coming. The pose is read from the report itself: the SDK's own
copy stands still for ever once anything on that connection (a gripper call) has met an error from C1 to C17.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from xarm.wrapper import XArmAPI

from far_app.types import Pose
from hw.xarm7.units import pose_from_rpy


@dataclass(frozen=True, kw_only=True)
class Told:
    """One fast report."""

    pose: Pose
    joints: Float[np.ndarray, "7"]
    """Radians."""
    state: int
    mode: int
    at: float
    """Monotonic seconds at which it was read here."""


class Telling:
    """The newest of each; filled by the SDK's report threads, read by any."""

    def __init__(self, slow: XArmAPI, fast: XArmAPI) -> None:
        self._slow, self._fast = slow, fast
        self.newest: Told | None = None
        self.error = 0
        """Controller error code of the newest slow report."""
        self.slow_at = time.monotonic()
        """When that was read."""
        slow.register_report_location_callback(self._on_slow)
        fast.register_report_location_callback(self._on_fast)

    def _on_slow(self, words: dict) -> None:
        self.error = int(self._slow._arm._error_code)
        self.slow_at = time.monotonic()

    def _on_fast(self, words: dict) -> None:
        report: Any = self._fast._arm.report_data
        pose, joints = (
            np.array(report.actual_tcp_pose, dtype=float),
            np.array(report.actual_joint_angle[:7], dtype=float),
        )
        self.newest = Told(
            pose=pose_from_rpy(pose), joints=joints, state=report.state, mode=report.mode, at=time.monotonic()
        )

    def wait_fast(self, after: float, seconds: float) -> Told | None:
        """The first fast report read later than a moment; None when none comes in time."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            newest = self.newest
            if newest is not None and newest.at > after:
                return newest
            time.sleep(0.002)
        return None

    def wait_slow(self, after: float, seconds: float) -> bool:
        """Wait for a slow report later than a moment; False when none comes in time."""
        deadline = time.monotonic() + seconds
        while self.slow_at <= after:
            if time.monotonic() > deadline:
                return False
            time.sleep(0.005)
        return True
