"""3Dconnexion's HID reports: the cap's six axes and two buttons.

    report 1   x y z         little-endian int16, ±350: right, toward the person, down
    report 2   rx ry rz      turns about the same axes
    report 3   buttons, one bit each
    report 1 of 13 bytes: all six axes (the wireless models)

The cap streams while it is deflected, says zero once when it is let go, then nothing. Left button: take over and hand
back. Right button: close, and open again.
"""

from __future__ import annotations

import struct

import numpy as np

FULL = 350.0
"""Counts at full deflection (the maker's figure; a little more is seen)."""
VENDORS = ("0000256F", "0000046D")
"""3Dconnexion, and Logitech for older models, as hidraw's HID_ID names them."""
TO_VIEW = np.array(((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)))
"""The cap's right, toward, down as forward, left, up: a rotation, so that turns go the same way."""
TAKE, GRIP = 1, 2
"""Bits of the buttons."""


class SpaceMouse:
    """hw.input_device.decoder.Decoder of hidraw, which hands over one report a read."""

    name = "SpaceMouse"
    quiet = 0.2
    size = 64

    def __init__(self) -> None:
        self._cap = np.zeros((2, 3))
        self._buttons = 0
        self.presses = 0
        self._closing = False

    def feed(self, raw: bytes) -> None:
        if len(raw) in (7, 13) and raw[0] in (1, 2):
            values = np.array(struct.unpack_from(f"<{(len(raw) - 1) // 2}h", raw, 1)) / FULL
            first = raw[0] - 1
            self._cap[first : first + len(values) // 3] = np.clip(values, -1.0, 1.0).reshape(-1, 3)
        elif len(raw) >= 2 and raw[0] == 3:
            pressed = raw[1] & ~self._buttons
            self._buttons = raw[1]
            self.presses += bool(pressed & TAKE)
            self._closing ^= bool(pressed & GRIP)

    @property
    def axes(self) -> np.ndarray:
        return (self._cap @ TO_VIEW.T).reshape(6)

    @property
    def grip(self) -> float:
        if not self._buttons & GRIP:
            return 0.0
        return 1.0 if self._closing else -1.0
