"""A camera without a device: each picture tells its own number in black and white blocks, and trouble comes on demand.

The number lies in every eye, in the middle of the picture, large enough to be read after cropping and shrinking
(`number_in`). Used by tests, and by rigs with `device = "synthetic"`, or with trouble at set times,
`device = "synthetic:unplugged@5+3,frozen@12+2"`: unplugged five seconds after the first frame for three seconds, …; or
with the troubles that a file holds at the time, `device = "synthetic:/tmp/trouble"` and `echo frozen > /tmp/trouble`.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from far_app.errors import ConfigError, RobotError
from hw.camera_config import CameraConfig
from hw.capture import Shot

TROUBLES = ("unplugged", "frozen", "stuck", "slow")
SLOW = 0.4
"""Seconds of delay while it is slow."""
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
        words = config.device.partition(":")[2]
        self._told = Path(words) if words.startswith("/") else None
        self._plan = trouble_plan(config.device) if self._told is None else []
        self._began: float | None = None
        self._due = 0.0
        self._last: Shot | None = None

    def _act_out(self) -> None:
        """Set the switches that the plan names, as the time has it, or that the file names now."""
        if self._told is not None:
            now = set(self._told.read_text().split()) if self._told.exists() else set()
        elif self._plan:
            self._began = self._clock() if self._began is None else self._began
            since = self._clock() - self._began
            now = {kind for kind, start, seconds in self._plan if start <= since < start + seconds}
        else:
            return
        self.unplugged, self.frozen, self.stuck = (kind in now for kind in TROUBLES[:3])
        self.delay = SLOW if "slow" in now else 0.0

    def open(self) -> None:
        self._act_out()
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
        self._act_out()
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


def trouble_plan(device: str) -> list[tuple[str, float, float]]:
    """(kind, start, duration) in seconds of each trouble that a device's name asks for."""
    plan = []
    for words in device.partition(":")[2].split(",") if ":" in device else ():
        match = re.fullmatch(r"(\w+)@([\d.]+)\+([\d.]+)", words)
        if match is None or match[1] not in TROUBLES:
            raise ConfigError(
                f"camera device '{device}': '{words}' must be KIND@START+SECONDS with KIND one of {', '.join(TROUBLES)}"
            )
        plan.append((match[1], float(match[2]), float(match[3])))
    return plan
