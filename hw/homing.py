"""The way home: let go, retreat, then a smooth path to the start pose, and wait until the arm really stands there.

A leg from pose A to pose B takes the time T that keeps the peak of a minimum-jerk profile under the home speeds:

    s(τ) = 10τ³ − 15τ⁴ + 6τ⁵,   peak speed 1.875 d/T,   peak acceleration 5.774 d/T²

Stepped once a servo period by hw/controller.py; the scene is never touched, and no time passes while the arm is held.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from far_app.config import TaskConfig
from far_app.motion import quat_from_rotvec, quat_multiply, rotation_between
from far_app.types import Pose
from hw.plant import Measured
from hw.rig import HomePath, RigConfig, SafetyLimits
from hw.safety import Along, violation

OPEN_ENOUGH = 0.95
"""Opening of the fingers that counts as open."""
LOWER_SPEED = 0.05
"""Metres a second while lowering what the hand holds."""
LOWER_AT_MOST = 0.15
"""Metres."""
CONTACT_LAG = 0.015
"""Metres by which the arm trails a lowering hand's command once it stands on something."""
SETTLED = 0.15
"""Seconds for which the arm must hold still at the start pose."""
STILL = 0.001
"""Metres the arm may creep in that time."""
PATIENCE = 3.0
"""Seconds after the path's end until an arm that is not home is a fault."""


@dataclass(frozen=True, kw_only=True)
class Leg:
    """A straight minimum-jerk motion."""

    start: Pose
    end: Pose
    seconds: float

    @classmethod
    def plan(cls, start: Pose, end: Pose, home: HomePath, limits: SafetyLimits) -> Leg:
        distance = float(np.linalg.norm(end.position - start.position))
        angle = float(np.linalg.norm(rotation_between(start.quaternion, end.quaternion)))
        seconds = max(
            1.875 * distance / min(home.speed, limits.speed),
            1.875 * angle / min(home.rotation_speed, limits.rotation_speed),
            math.sqrt(5.774 * distance / limits.acceleration),
            math.sqrt(5.774 * angle / limits.rotation_acceleration),
            0.05,
        )
        return cls(start=start, end=end, seconds=seconds)

    def at(self, seconds: float) -> Pose:
        """Where to be after this time on the leg."""
        tau = min(1.0, seconds / self.seconds)
        share = tau**3 * (10.0 - 15.0 * tau + 6.0 * tau**2)
        turn = rotation_between(self.start.quaternion, self.end.quaternion)
        return Pose(
            position=self.start.position + share * (self.end.position - self.start.position),
            quaternion=quat_multiply(quat_from_rotvec(share * turn), self.start.quaternion),
        )


def breach(leg: Leg, limits: SafetyLimits, samples: int = 50) -> str:
    """Where a leg leaves the box, or moves away from it; empty when it does not."""
    before = violation(leg.start.position, limits)
    for tau in np.linspace(0.0, 1.0, samples):
        position = leg.at(tau * leg.seconds).position
        now = violation(position, limits)
        if now > before + 1e-9:
            at = ", ".join(f"{x:.3f}" for x in position)
            return f"the path home leaves the workspace box at ({at}) m by {now:.3f} m; move the arm by hand"
        before = now
    return ""


class Phase(StrEnum):
    ASK = "ask"
    LOWER = "lower"
    RELEASE = "release"
    RETREAT = "retreat"
    RETURN = "return"
    SETTLE = "settle"
    DONE = "done"


SHARE = {
    Phase.ASK: (0.0, 0.0), Phase.LOWER: (0.0, 0.1), Phase.RELEASE: (0.1, 0.2), Phase.RETREAT: (0.2, 0.4),
    Phase.RETURN: (0.4, 0.9), Phase.SETTLE: (0.9, 1.0), Phase.DONE: (1.0, 1.0),
}  # fmt: skip
"""Homing progress at each phase's beginning and end."""


class Homing:
    """One way home. `step` gives each servo period's wish; `failed` says why it cannot be completed."""

    def __init__(self, rig: RigConfig, task: TaskConfig, measured: Measured, gripper: float) -> None:
        self._rig, self._task = rig, task
        self.start = Pose(position=np.array(rig.start_position), quaternion=np.array(rig.start_quaternion))
        self.gripper = gripper
        self.failed = ""
        self._leg: Leg | None = None
        self._seconds = 0.0
        self._trail: deque[Pose] = deque()
        self._retreat_to = self._retreat_position(measured)
        self._left = self._way()
        release = {"open": Phase.RELEASE, "lower_then_open": Phase.LOWER, "ask": Phase.ASK}[task.release]
        is_open = measured.gripper > OPEN_ENOUGH and gripper < 0.0
        self._enter(Phase.RELEASE if is_open else release)
        retreat = Pose(position=self._retreat_to, quaternion=measured.eef.quaternion)
        for start, end in itertools.pairwise((measured.eef, retreat, *self._left)):
            self.failed = self.failed or breach(Leg.plan(start, end, rig.home, rig.safety), rig.safety)

    def _retreat_position(self, measured: Measured) -> np.ndarray:
        limits = self._rig.safety
        return np.clip(measured.eef.position + np.array(self._task.retreat), limits.box_min, limits.box_max)

    def _way(self) -> list[Pose]:
        """Where to go after the retreat, the start pose last."""
        points = (self.start.position + np.array(offset) for offset in self._task.path)
        return [*(Pose(position=point, quaternion=self.start.quaternion) for point in points), self.start]

    @property
    def waiting(self) -> str:
        """What the operator must do before the arm goes on; empty while it needs nobody."""
        asking = self.phase is Phase.ASK
        return "take what the hand holds, then resume: the hand will open and go home" if asking else ""

    @property
    def progress(self) -> float:
        low, high = SHARE[self.phase]
        whole = self._leg.seconds if self._leg is not None else SETTLED
        share = min(1.0, self._seconds / whole)
        if self.phase is Phase.RETURN:
            legs = len(self._task.path) + 1
            share = (legs - len(self._left) + share) / legs
        return low + (high - low) * share

    def released(self) -> None:
        """The operator answered: the hand may open."""
        if self.phase is Phase.ASK:
            self._enter(Phase.RELEASE)

    def interrupt(self) -> None:
        """The arm was held: the present leg is planned anew from where it stands when it goes on."""
        self._leg = None
        self._trail.clear()

    def _enter(self, phase: Phase) -> None:
        self.phase, self._seconds, self._leg = phase, 0.0, None
        self._trail.clear()

    def step(self, measured: Measured, commanded: Pose, period: float) -> Along:
        """The wish for the coming servo period."""
        self._seconds += period
        if self.phase is Phase.ASK:
            return Along(pose=commanded)
        if self.phase is Phase.LOWER:
            return self._lower(measured, commanded)
        self.gripper = -1.0
        if self.phase is Phase.RELEASE:
            if measured.gripper > OPEN_ENOUGH or self._seconds >= self._rig.home.open_seconds:
                self._enter(Phase.SETTLE if self._near(measured) else Phase.RETREAT)
            return Along(pose=commanded)
        if self.phase is Phase.RETREAT:
            above = Pose(position=self._retreat_to, quaternion=commanded.quaternion)
            return self._travel(commanded, above, Phase.RETURN)
        if self.phase is Phase.RETURN:
            last = len(self._left) == 1
            wish = self._travel(commanded, self._left[0], Phase.SETTLE if last else Phase.RETURN)
            if self._leg is None and not last:
                self._left.pop(0)
            return wish
        self._settle(measured, period)
        return Along(pose=self.start)

    def _travel(self, here: Pose, end: Pose, then: Phase) -> Along:
        if self._leg is None:
            self._leg = Leg.plan(here, end, self._rig.home, self._rig.safety)
            self._seconds = 0.0
            return Along(pose=here)
        pose = self._leg.at(self._seconds)
        if self._seconds >= self._leg.seconds:
            self._enter(then)
        return Along(pose=pose)

    def _lower(self, measured: Measured, here: Pose) -> Along:
        if self._leg is None:
            floor = max(here.position[2] - LOWER_AT_MOST, self._rig.safety.box_min[2])
            end = Pose(position=np.array((*here.position[:2], floor)), quaternion=here.quaternion)
            self._leg = Leg(start=here, end=end, seconds=max(0.05, (here.position[2] - floor) / LOWER_SPEED))
            self._seconds = 0.0
        pose = self._leg.at(self._seconds)
        touching = measured.eef.position[2] - pose.position[2] > CONTACT_LAG
        if touching or self._seconds >= self._leg.seconds:
            self._enter(Phase.RELEASE)
        return Along(pose=pose)

    def _near(self, measured: Measured) -> bool:
        home = self._rig.home
        return (
            float(np.linalg.norm(measured.eef.position - self.start.position)) < home.tolerance_translation
            and float(np.linalg.norm(rotation_between(measured.eef.quaternion, self.start.quaternion)))
            < home.tolerance_rotation
        )

    def _settle(self, measured: Measured, period: float) -> None:
        """Home when the arm measures near the start pose and has hardly moved for a while."""
        self._trail.append(measured.eef)
        if len(self._trail) * period < SETTLED:
            return
        crept = float(np.linalg.norm(measured.eef.position - self._trail.popleft().position))
        if self._near(measured) and crept < STILL:
            self._enter(Phase.DONE)
        elif self._seconds > PATIENCE:
            off = float(np.linalg.norm(measured.eef.position - self.start.position))
            turn = float(np.linalg.norm(rotation_between(measured.eef.quaternion, self.start.quaternion)))
            self.failed = (
                f"the arm stands {off * 1e3:.0f} mm and {turn:.2f} rad from its start pose (allowed: "
                f"{self._rig.home.tolerance_translation * 1e3:.0f} mm, {self._rig.home.tolerance_rotation} rad); "
                "see what it touches, then resume and go home again"
            )
