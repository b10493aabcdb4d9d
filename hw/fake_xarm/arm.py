"""The arm of the fake controller: mode, state, errors, and a hand that goes to the newest servo target.

Servo mode as the vendor describes it: unbuffered, the newest target only, at full speed, then hold. A target that asks
for more than 1200 mm/s raises C60. Lengths here are the wire's millimetres. Time passes by `advance`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from far_app.motion import quat_from_rotvec, quat_multiply, rotation_between, rotvec_from_quat

SPEED = 1000.0
"""Millimetres a second toward a target in servo mode."""
TURN_SPEED = math.pi
"""Radians a second."""
OVERSPEED = 1200.0
"""Millimetres a second implied by a target that raise C60."""
SHORTEST = 0.004
"""Seconds: targets are taken at 250 Hz at most, so one that comes sooner after another is not faster for it."""
MANUAL = 2
"""The mode in which the arm gives way to a person's hands."""
EMERGENCY = (1, 2, 3)
"""Errors of an emergency stop: the motors lose their power."""


class ArmState(IntEnum):
    MOVING = 1
    READY = 2
    PAUSED = 3
    STOPPED = 4
    CONFIG_CHANGED = 5


@dataclass(kw_only=True)
class FakeArm:
    """What the controller knows of its arm."""

    position: np.ndarray = field(default_factory=lambda: np.array((420.0, 30.0, 250.0)))
    """Millimetres, base frame, at the tool centre point."""
    quaternion: np.ndarray = field(default_factory=lambda: np.array((1.0, 0.0, 0.0, 0.0)))
    """xyzw."""
    joints: np.ndarray = field(default_factory=lambda: np.array((0.0, 0.32, 0.0, 1.03, 0.0, 0.71, 0.0)))
    """Radians; they do not follow the hand, but for the first: this fake has no kinematics."""
    tcp_offset: list[float] = field(default_factory=lambda: [0.0, 0.0, 172.0, 0.0, 0.0, 0.0])
    load: list[float] = field(default_factory=lambda: [0.82, 0.0, 0.0, 48.0])
    sensitivity: int = 3
    mode: int = 0
    state: int = ArmState.STOPPED
    enabled: bool = False
    error: int = 0
    warning: int = 0
    floor: float = -math.inf
    """Millimetres: what the hand, or what it holds, comes to stand on."""
    emergency: int = 0
    """The emergency stop that is pressed (1, 2 or 3); its error cannot be cleared until it is released."""

    def __post_init__(self) -> None:
        self._goal = (self.position.copy(), self.quaternion.copy())
        self._target_at = -math.inf

    def advance(self, seconds: float) -> None:
        """The hand moves toward the newest target."""
        if self.state not in (ArmState.READY, ArmState.MOVING):
            return
        goal, orientation = self._goal
        way = goal - self.position
        distance = float(np.linalg.norm(way))
        self.position = goal.copy() if distance <= SPEED * seconds else self.position + way * SPEED * seconds / distance
        self.position[2] = max(self.position[2], self.floor)
        turn = rotation_between(self.quaternion, orientation)
        angle = float(np.linalg.norm(turn))
        if angle <= TURN_SPEED * seconds:
            self.quaternion = orientation.copy()
        else:
            self.quaternion = quat_multiply(quat_from_rotvec(turn * TURN_SPEED * seconds / angle), self.quaternion)
        self.joints[0] = math.atan2(self.position[1], self.position[0])
        self.state = ArmState.MOVING if distance > 0.01 or angle > 1e-4 else ArmState.READY

    def servo(self, position: np.ndarray, quaternion: np.ndarray, now: float) -> None:
        """A servo target, in mode 1 and able to move; else nothing happens (a real controller also answers so)."""
        if self.mode != 1 or self.state not in (ArmState.READY, ArmState.MOVING):
            return
        step = float(np.linalg.norm(position - self._goal[0]))
        if step / max(SHORTEST, now - self._target_at) > OVERSPEED and step > OVERSPEED * SHORTEST:
            self.fail(60)
            return
        self._target_at = now
        self._goal = (position, quaternion / np.linalg.norm(quaternion))

    def lead(self, offset: np.ndarray) -> bool:
        """A person pushes the hand this far, millimetres; only in manual mode, and able to move, does it give way."""
        if self.mode != MANUAL or self.state not in (ArmState.READY, ArmState.MOVING):
            return False
        self.position = self.position + offset
        self._goal = (self.position.copy(), self.quaternion.copy())
        return True

    def fail(self, code: int) -> None:
        """An error: the arm stops where it is."""
        self.error = code
        if code in EMERGENCY:
            self.enabled = False
        self._stop(ArmState.STOPPED)

    def press_emergency(self, code: int) -> None:
        self.emergency = code
        self.fail(code)

    def release_emergency(self) -> None:
        self.emergency = 0

    def clear_error(self) -> None:
        self.error = self.emergency

    def set_mode(self, mode: int) -> None:
        self.mode = mode
        self._stop(ArmState.CONFIG_CHANGED)

    def configured(self) -> None:
        """A changed tool or load: mode 0, to be started anew."""
        self.set_mode(0)

    def set_state(self, state: int) -> None:
        if state == 0:
            able = self.enabled and not self.error
            self._stop(ArmState.READY if able else ArmState.STOPPED)
        elif state in (3, 4):
            self._stop(ArmState.PAUSED if state == 3 else ArmState.STOPPED)

    def _stop(self, state: int) -> None:
        self.state = state
        self._goal = (self.position.copy(), self.quaternion.copy())
        self._target_at = -math.inf

    def rotvec(self) -> list[float]:
        """Axis-angle, radians."""
        return rotvec_from_quat(self.quaternion).tolist()

    def rpy(self) -> list[float]:
        """Roll, pitch, yaw, radians: R = Rz(yaw) Ry(pitch) Rx(roll)."""
        x, y, z, w = self.quaternion.tolist()
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return [roll, pitch, yaw]
