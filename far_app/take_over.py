"""A person moves the arm: steps of 5 mm from the page, continuous motion from a device the hw server reads.

Both become actions of a policy's own kind (−1 … 1, base frame), so that they pass the same integrator, the same safety
filter and the same watchdog, and are recorded the same way. A source that falls silent while it has the arm means hold.
Pure; the session (far_app/session/steering.py) asks it once a tick.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float

from far_app.device_input import DeviceInput
from far_app.motion import ActionScale
from far_app.types import ACTION_DIM, ARM_DIMS
from far_app.wire import register

STEP = 0.005
"""Metres a press."""
TURN = 0.05
"""Radians a press."""
WAITING = 3
"""Presses that may wait to be carried out: more are refused, so that the arm stands soon after the last press."""
PACE = 0.4
"""Of the largest action: how fast steps are carried out."""
PAGE_SILENT = 2.0
"""Seconds without a page that someone looks at, after which steps from the page count as silent."""
DEVICE_SILENT = 0.25
"""Seconds without a sign of life of the device, after which it counts as silent."""


@register
class Move(StrEnum):
    """One press; base frame, x away from the arm's base, z up."""

    FORWARD = "forward"
    BACK = "back"
    LEFT = "left"
    RIGHT = "right"
    UP = "up"
    DOWN = "down"
    ROLL_PLUS = "roll_plus"
    ROLL_MINUS = "roll_minus"
    PITCH_PLUS = "pitch_plus"
    PITCH_MINUS = "pitch_minus"
    YAW_PLUS = "yaw_plus"
    YAW_MINUS = "yaw_minus"
    OPEN = "open"
    CLOSE = "close"


_AXES = {
    Move.FORWARD: (0, STEP), Move.BACK: (0, -STEP), Move.LEFT: (1, STEP), Move.RIGHT: (1, -STEP),
    Move.UP: (2, STEP), Move.DOWN: (2, -STEP), Move.ROLL_PLUS: (3, TURN), Move.ROLL_MINUS: (3, -TURN),
    Move.PITCH_PLUS: (4, TURN), Move.PITCH_MINUS: (4, -TURN), Move.YAW_PLUS: (5, TURN), Move.YAW_MINUS: (5, -TURN),
}  # fmt: skip
"""Dimension, and metres or radians."""
_GRIPPER = {Move.OPEN: -1.0, Move.CLOSE: 1.0}


@register
@dataclass(frozen=True, kw_only=True)
class Nudge:
    """From the page to the app: one press."""

    move: Move
    by: str = ""


@register
class Source(StrEnum):
    """Where the person's motion comes from."""

    PAGE = "page"
    DEVICE = "device"


@register
@dataclass(frozen=True, kw_only=True)
class Steering:
    """What the page is told of a person's part in the attempt."""

    source: str = ""
    """"page" or "device" while a person has the arm."""
    silent: str = ""
    """Why the arm is held though a person has it."""
    unavailable: str = ""
    """Why nobody can take over in this session."""
    device: str = ""
    """The device that is there, by name; empty without one."""
    trouble: str = ""
    """Why the device cannot be used."""
    ticks: int = 0
    """A person moved the arm in so many ticks of this attempt."""


class Hand:
    """The person's hand on the arm: actions while it has it, None while the policy acts."""

    def __init__(self, scale: ActionScale) -> None:
        self._unit = np.array([scale.translation] * 3 + [scale.rotation] * 3)
        self.source: Source | None = None
        """Who has the arm; None while the policy does."""
        self._waiting = np.zeros(ARM_DIMS)
        """Metres and radians not yet carried out."""
        self._gripper = -1.0

    def take(self, gripper: float, source: Source) -> None:
        """The person has the arm; the gripper stays as it was commanded."""
        self.source, self._gripper = source, gripper
        self._waiting = np.zeros(ARM_DIMS)

    def let_go(self) -> None:
        self.source = None

    def nudge(self, move: Move) -> str:
        """One press; why it is refused, or "" when it is taken."""
        if self.source is None:
            return "the policy has the arm: take over first"
        self.source = Source.PAGE
        if move in _GRIPPER:
            self._gripper = _GRIPPER[move]
            return ""
        axis, way = _AXES[move]
        if abs(self._waiting[axis] + way) > WAITING * abs(way) * (1 + 1e-9):
            return f"{WAITING} steps are still being carried out; press again when the arm stands"
        self._waiting[axis] += way
        return ""

    def action(self, device: DeviceInput | None) -> Float[np.ndarray, "A"] | None:
        """The coming tick's action, or None while the policy has the arm. Motion of a device that is alive comes before
        waiting steps, and clears them."""
        if self.source is None:
            return None
        action = np.zeros(ACTION_DIM)
        if device is not None and not device.trouble and device.age < DEVICE_SILENT:
            if np.any(device.motion) or device.gripper:
                self.source, self._waiting = Source.DEVICE, np.zeros(ARM_DIMS)
            if device.gripper:
                self._gripper = device.gripper
            action[:ARM_DIMS] = np.clip(device.motion, -1.0, 1.0)
        if self.source is Source.PAGE:
            part = np.clip(self._waiting, -PACE * self._unit, PACE * self._unit)
            self._waiting = self._waiting - part
            action[:ARM_DIMS] = part / self._unit
        action[6] = self._gripper
        return action

    def silence(self, device: DeviceInput | None, page_unseen: float) -> str:
        """Why the source that has the arm cannot be trusted to be there; "" when it is. `page_unseen`: seconds since
        somebody was last known to have the page open."""
        if self.source is Source.PAGE and page_unseen > PAGE_SILENT:
            return f"the page that has the arm has been silent for {page_unseen:.1f} s (limit {PAGE_SILENT:g} s)"
        if self.source is Source.DEVICE:
            if device is None:
                return "the input device is gone"
            if device.trouble:
                return f"{device.name}: {device.trouble}"
            if device.age >= DEVICE_SILENT:
                return f"{device.name} has been silent for {device.age:.1f} s (limit {DEVICE_SILENT:g} s)"
        return ""
