"""The [input_device] table of a rig file: what a person may move the arm with, and how fast."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from far_app.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class InputDeviceSettings:
    kind: Literal["", "spacemouse", "gamepad"] = ""
    """Empty: none is looked for."""
    path: str = ""
    """/dev/hidrawN of a SpaceMouse, /dev/input/eventN (or a name below /dev/input/by-id) of a gamepad; the first that
    is found when empty."""
    speed: float = 0.4
    """Translation at full deflection, as a share of the largest action."""
    turn_speed: float = 0.4
    """Rotation at full deflection, likewise."""
    deadzone: float = 0.12
    """Share of the full deflection that counts as let go."""
    facing: bool = False
    """The person looks at the arm from the front: left and right, forward and back are swapped."""
    signs: tuple[float, float, float, float, float, float] = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    """−1 turns an axis around (x, y, z, and about x, y, z; base frame)."""

    def __post_init__(self) -> None:
        if self.kind not in ("", "spacemouse", "gamepad"):
            raise ConfigError(
                f"input_device.kind is '{self.kind}'; choose one of: spacemouse, gamepad, or leave it out"
            )
        for name in ("speed", "turn_speed"):
            if not 0 < getattr(self, name) <= 1:
                raise ConfigError(f"input_device.{name} is {getattr(self, name)}, must be above 0 and at most 1")
        if not 0 <= self.deadzone < 1:
            raise ConfigError(f"input_device.deadzone is {self.deadzone}, must be at least 0 and below 1")
        if any(abs(sign) != 1 for sign in self.signs):
            raise ConfigError(f"input_device.signs are {self.signs}, each must be 1 or -1")
