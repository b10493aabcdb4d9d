"""What a device's bytes amount to: six axes, a gripper, presses of the take-over button."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from jaxtyping import Float


class Decoder(Protocol):
    """Fed with what the kernel hands over; knows no file and no clock. Axes are of the person's own view: x forward,
    y left, z up, and the turns about them, right-handed, in [−1, 1]."""

    name: str
    quiet: float
    """Seconds for which the device may say nothing while it is deflected; then it is taken to be gone."""
    size: int
    """Bytes to read at once."""

    def feed(self, raw: bytes) -> None:
        """Take one read's bytes; what is not known is passed over."""
        ...

    @property
    def axes(self) -> Float[np.ndarray, "6"]: ...

    @property
    def grip(self) -> float:
        """−1 opens, +1 closes, 0 neither; as the newest bytes say."""
        ...

    @property
    def presses(self) -> int:
        """Of the take-over button, so far."""
        ...
