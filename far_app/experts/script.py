"""What all scripted experts are made of: a style of their own, a hand that steps toward a pose, phases in order.

Times are seconds and speeds shares of a full action, so that one expert serves an arm at 30 Hz and one at 7 Hz.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from far_app.config import TaskConfig
from far_app.motion import ActionScale, quat_from_rotvec, quat_multiply, rotation_between
from far_app.types import ACTION_DIM, Observation, Pose

GAIN = 0.3
"""Share of the remaining distance asked for in 1/30 s; the arm answers with about three such ticks' delay."""
DOWN = np.array((0.0, 0.0, 1.0))
"""The axis a downward hand is turned about."""
SPIN = 1.0
"""Radians a second: the hand's turning is slow to follow, and one that lags behind swings."""


@dataclass(frozen=True, kw_only=True)
class Style:
    """One demonstration's own way of doing things."""

    speed: float
    """Largest action component, in (0, 1]."""
    noise: float
    """Standard deviation added to the arm's action."""
    hover: float
    """Height above the object before descending, metres."""
    offset: Float[np.ndarray, "3"]
    """Grasp offset, metres."""
    via: Float[np.ndarray, "2"]
    """Sideways detour of the approach, metres."""
    dwell: float
    """Seconds the gripper takes before the lift."""

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Style:
        return cls(
            speed=rng.uniform(0.7, 1.0), noise=rng.uniform(0.02, 0.10), hover=rng.uniform(0.05, 0.10),
            offset=rng.normal(0.0, (0.003, 0.003, 0.002)), via=rng.uniform(-0.05, 0.05, 2),
            dwell=int(rng.integers(12, 18)) / 30.0,
        )  # fmt: skip


class Hand:
    """Steps toward poses, in one demonstration's style."""

    def __init__(self, task: TaskConfig, style: Style, scale: ActionScale, rng: np.random.Generator) -> None:
        self.style, self.scale, self.rng = style, scale, rng
        self.rate = task.rate
        self.gain = 1.0 - (1.0 - GAIN) ** (30.0 / task.rate)

    def toward(
        self, observation: Observation, goal: Pose, gripper: float, pace: float = 1.0, spin: float = math.inf
    ) -> Float[np.ndarray, "A"]:
        """A step toward a pose, limited to `pace` of the style's speed and to `spin` (radians a second), with the
        style's noise on the arm."""
        style, speed = self.style, pace * self.style.speed
        turn_speed = min(speed, spin / (self.scale.rotation * self.rate))
        action = np.empty(ACTION_DIM)
        move = self.gain * (goal.position - observation.eef.position) / self.scale.translation
        turn = self.gain * rotation_between(observation.eef.quaternion, goal.quaternion) / self.scale.rotation
        action[:3] = move * min(1.0, speed / max(1e-9, float(np.abs(move).max())))
        action[3:6] = np.clip(turn, -turn_speed, turn_speed)
        action[:6] += self.rng.normal(0.0, style.noise, 6) * np.array((1, 1, 1, 0.5, 0.5, 0.5))
        action[6] = gripper
        return np.clip(action, -1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Phase:
    """One stretch of the way: until the hand is at the goal, or its time is over."""

    goal: Callable[[Observation], Pose]
    gripper: float
    near: float = 0.010
    """Metres from the goal that count as there."""
    turn: float = 0.12
    """Radians."""
    dwell: float = 0.0
    """Seconds to stay once there."""
    least: float = 0.0
    """Seconds the phase lasts at least."""
    done: Callable[[Observation], bool] | None = None
    """What counts as there, in place of being near the goal."""
    pace: float = 1.0
    """Share of the style's speed: less where haste would throw or miss something."""
    patience: float = math.inf
    """Seconds after which the next phase begins anyway."""
    lost: Callable[[Observation], bool] = lambda observation: False
    """Start over when this holds."""


class Script:
    """An expert that goes through phases; the last one lasts."""

    def __init__(self, hand: Hand, phases: Sequence[Phase]) -> None:
        self.hand, self.phases = hand, phases
        self._begin(0)

    def __call__(self, observation: Observation) -> Float[np.ndarray, "A"]:
        phase = self.phases[self.index]
        if self.index and phase.lost(observation):
            self._begin(0)
        elif self._done(phase, observation) and self.index + 1 < len(self.phases):
            self._begin(self.index + 1)
        phase = self.phases[self.index]
        self.ticks += 1
        return self.hand.toward(observation, phase.goal(observation), phase.gripper, phase.pace, SPIN)

    def _begin(self, index: int) -> None:
        self.index, self.ticks, self.held = index, 0, 0

    def _done(self, phase: Phase, observation: Observation) -> bool:
        if phase.done is not None:
            there = phase.done(observation)
        else:
            goal, eef = phase.goal(observation), observation.eef
            near = np.linalg.norm(goal.position - eef.position) < phase.near
            there = bool(near and np.linalg.norm(rotation_between(eef.quaternion, goal.quaternion)) < phase.turn)
        self.held = self.held + 1 if there else 0
        if self.ticks >= phase.patience * self.hand.rate:
            return True
        return there and self.held >= phase.dwell * self.hand.rate and self.ticks >= phase.least * self.hand.rate


def yaw_of(quaternion: Float[np.ndarray, "4"]) -> float:
    """Rotation about the vertical (xyzw), radians."""
    x, y, z, w = quaternion
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def folded(yaw: float, symmetry: float) -> float:
    """The equivalent yaw nearest to zero of what looks the same after turning by `symmetry` radians."""
    return float((yaw + symmetry / 2) % symmetry - symmetry / 2)


class Steady:
    """A yaw that means the same after `symmetry` radians, without jumps: always the equivalent nearest to the last."""

    def __init__(self, symmetry: float) -> None:
        self.symmetry, self.last = symmetry, 0.0

    def __call__(self, yaw: float) -> float:
        self.last += folded(yaw - self.last, self.symmetry)
        return self.last


def square_yaw(quaternion: Float[np.ndarray, "4"]) -> float:
    """Yaw of a cube (xyzw), the equivalent one in [−π/4, π/4)."""
    return folded(yaw_of(quaternion), np.pi / 2)


def turned(start: Pose, yaw: float) -> Float[np.ndarray, "4"]:
    """The start pose's orientation, turned about the vertical."""
    return quat_multiply(quat_from_rotvec(yaw * DOWN), start.quaternion)
