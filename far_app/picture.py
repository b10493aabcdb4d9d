"""How a camera's frame becomes the picture a policy sees: one pure function, live and from a dataset alike.

    frame ─ one eye of a stereo pair ─ turned ─ cropped (or its largest centred square) ─ shrunk by area ─▶ size × size

Called by hw/hardware_view.py for live frames and by far_app/learning/dataset.py for stored ones. The order of the
colour channels does not matter to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from far_app.errors import ConfigError

Eye = Literal["", "left", "right"]


@dataclass(frozen=True, kw_only=True)
class Framing:
    """Which part of a camera's frame a policy sees."""

    eye: Eye = ""
    """Half of a side-by-side stereo frame; empty for a camera with one lens."""
    rotate: int = 0
    """Degrees counter-clockwise: 0, 90, 180 or 270."""
    crop: tuple[int, ...] = ()
    """(left, top, width, height), pixels of the eye after turning; empty for the largest centred square."""

    def __post_init__(self) -> None:
        if self.eye not in ("", "left", "right"):
            raise ConfigError(f"eye is '{self.eye}', must be left, right or empty (one lens)")
        if self.rotate not in (0, 90, 180, 270):
            raise ConfigError(f"rotate is {self.rotate}, must be 0, 90, 180 or 270 degrees")
        if self.crop and (len(self.crop) != 4 or min(self.crop) < 0 or min(self.crop[2:]) < 1):
            raise ConfigError(f"crop is {self.crop}, must be left, top, width, height in pixels, or empty")

    def words(self) -> str:
        """For people."""
        parts = [f"{self.eye} eye"] if self.eye else []
        parts += [f"turned by {self.rotate}°"] if self.rotate else []
        if self.crop:
            left, top, width, height = self.crop
            parts.append(f"crop {width}×{height} at ({left}, {top})")
        else:
            parts.append("largest centred square")
        return ", ".join(parts)

    def box(self, height: int, width: int) -> tuple[int, int, int, int]:
        """The crop (left, top, width, height) within a turned eye of that size. Raises ConfigError where it does not
        fit."""
        if not self.crop:
            side = min(height, width)
            return (width - side) // 2, (height - side) // 2, side, side
        left, top, wide, high = self.crop
        if left + wide > width or top + high > height:
            raise ConfigError(
                f"crop {wide}×{high} at ({left}, {top}) does not fit a picture of {width}×{height} pixels; change the "
                "crop, or the camera's width and height"
            )
        return left, top, wide, high


def framed(frame: UInt8[np.ndarray, "H W 3"], framing: Framing) -> UInt8[np.ndarray, "h w 3"]:
    """The part of a frame that a policy sees, at the frame's own resolution; a view into it, not a copy."""
    if framing.eye:
        half = frame.shape[1] // 2
        frame = frame[:, :half] if framing.eye == "left" else frame[:, half:]
    if framing.rotate:
        frame = np.rot90(frame, framing.rotate // 90)
    left, top, width, height = framing.box(*frame.shape[:2])
    return frame[top : top + height, left : left + width]


def seen(
    frame: UInt8[np.ndarray, "H W 3"], framing: Framing, size: int, *, quick: bool = False
) -> UInt8[np.ndarray, "size size 3"]:
    """The picture a policy sees of a frame. One that is `size` × `size` already comes back unchanged. `quick`: for
    people, who need no average over every pixel's area; a quarter of the time."""
    picture = np.ascontiguousarray(framed(frame, framing))
    if picture.shape[:2] == (size, size):
        return picture
    import cv2  # here: the core loads nothing heavier than numpy

    way = cv2.INTER_LINEAR if quick else cv2.INTER_AREA
    return np.asarray(cv2.resize(picture, (size, size), interpolation=way), np.uint8)
