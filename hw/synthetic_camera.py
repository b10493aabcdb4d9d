"""A camera without a device: each picture tells its own number in black and white blocks, and trouble comes on demand.

The number lies in every eye, in the middle of the picture, large enough to be read after cropping and shrinking
(`number_in`). Used by tests, and by rigs with `device = "synthetic"`.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from jaxtyping import UInt8

from far_app.errors import ConfigError, RobotError
from hw.camera_config import CameraConfig
from hw.capture import Shot

BITS = 16
"""Of the number, as blocks of a square grid."""
GRID = 4


def numbered(number: int, height: int, width: int) -> UInt8[np.ndarray, "H W 3"]:
    """A grey picture with a number in blocks over the middle half of its largest centred square."""
    picture = np.full((height, width, 3), 90, np.uint8)
    cell = min(height, width) // (2 * GRID)
    top, left = (height - GRID * cell) // 2, (width - GRID * cell) // 2
    for bit in range(BITS):
        y, x = top + cell * (bit // GRID), left + cell * (bit % GRID)
        picture[y : y + cell, x : x + cell] = 255 if number >> bit & 1 else 0
    return picture


def number_in(picture: UInt8[np.ndarray, "S S 3"]) -> int:
    """The number in a picture, read from the middle of every block; of a square that was cut out in the centre."""
    size = picture.shape[0]
    cell = size / (2 * GRID)
    first = size / 4 + cell / 2
    places = [(round(first + cell * (bit // GRID)), round(first + cell * (bit % GRID))) for bit in range(BITS)]
    return sum(1 << bit for bit, place in enumerate(places) if picture[place].mean() > 128)


class SyntheticCapture:
    """A Capture with trouble on demand; its switches may be set from any thread."""

    def __init__(self, config: CameraConfig, clock: Callable[[], float] = time.monotonic) -> None:
        self._config, self._clock = config, clock
        self.unplugged = False
        """Gives no frame and cannot be opened."""
        self.frozen = False
        """The same picture again, with new timestamps."""
        self.stuck = False
        """The same buffer again, timestamp and all."""
        self.skip = 0
        """Frames to leave out now, as a full bus does."""
        self.delay = 0.0
        """Seconds from capture to arrival."""
        self.gives: tuple[int, int] | None = None
        """Height and width it really gives, where they are not what it was asked for."""
        self.number = 0
        """Of the newest frame."""
        self.opened = 0
        self._open = False
        self._due = 0.0
        self._last: Shot | None = None

    def open(self) -> None:
        if self.unplugged:
            raise RobotError("the synthetic camera is unplugged; plug it in")
        height, width = self.gives or (self._config.height, self._config.width)
        if (height, width) != (self._config.height, self._config.width):
            raise ConfigError(
                f"the synthetic camera gives {width}×{height}, the rig asks for {self._config.width}×"
                f"{self._config.height}; set width and height"
            )
        self.opened += 1
        self._open = True
        self._due = self._clock()

    def grab(self) -> Shot:
        if self.unplugged or not self._open:
            raise RobotError("the synthetic camera is unplugged; plug it in")
        period = 1.0 / self._config.rate
        skipped, self.skip = self.skip, 0
        self._due = max(self._due + period * (1 + skipped), self._clock() - self.delay - period)
        time.sleep(max(0.0, self._due + self.delay - self._clock()))
        self.number += 1 + skipped
        if self.stuck and self._last is not None:
            return self._last
        if self.frozen and self._last is not None:
            return Shot(image=self._last.image, stamp=self._due)
        self._last = Shot(image=self._picture(), stamp=self._due)
        return self._last

    def close(self) -> None:
        self._open = False

    def _picture(self) -> UInt8[np.ndarray, "H W 3"]:
        config = self._config
        if not config.eye:
            return numbered(self.number, config.height, config.width)
        half = numbered(self.number, config.height, config.width // 2)
        return np.concatenate([half, half], axis=1)
