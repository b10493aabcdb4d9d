"""What an input device at the arm (SpaceMouse, gamepad) asks for; read by the hw server, told with each observation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True)
class DeviceInput:
    """One device, at one moment."""

    name: str
    """For people."""
    motion: Float[np.ndarray, "6"]
    """Translation and rotation in action units, base frame, within [−1, 1]; zeros when let go."""
    gripper: float = 0.0
    """−1 opens, +1 closes, 0 leaves it as it is."""
    presses: int = 0
    """Presses of its take-over button since the hw server began."""
    age: float = math.inf
    """Seconds since the device was last known to be there, when this was published. A time span: it means the same on
    every machine."""
    trouble: str = ""
    """Why it cannot be used; empty when it can."""
