"""A gamepad's input events (evdev): two sticks, a cross, buttons; Linux's own codes, so any pad its drivers know.

    struct input_event { long sec; long usec; u16 type; u16 code; s32 value; }      24 bytes, 64-bit

Left stick: forward and left; right stick: up, and turn about the vertical; cross: tilt. Nothing moves unless the left
shoulder button is held: a pad may lie on its stick. A closes, B opens, Start takes over and hands back.
"""

from __future__ import annotations

import struct

import numpy as np

EVENT = struct.Struct("llHHi")
EV_SYN, EV_KEY, EV_ABS = 0, 1, 3
SYN_DROPPED = 3
ABS_X, ABS_Y, ABS_RX, ABS_RY, HAT_X, HAT_Y = 0, 1, 3, 4, 16, 17
SOUTH, EAST, SHOULDER, START = 0x130, 0x131, 0x136, 0x13B
STICKS = {ABS_X: (1, -1.0), ABS_Y: (0, -1.0), ABS_RX: (5, -1.0), ABS_RY: (2, -1.0), HAT_X: (3, 1.0), HAT_Y: (4, -1.0)}
"""Code to axis and sign: sticks count to the right and toward the person."""
WHOLE = (-32768, 32767)


class Gamepad:
    """hw.input_device.decoder.Decoder of an evdev device."""

    name = "gamepad"
    quiet = 1.0
    size = 64 * EVENT.size

    def __init__(self, ranges: dict[int, tuple[int, int]] | None = None) -> None:
        """`ranges`: least and greatest value by axis, as the kernel tells them; 16 bits where it does not."""
        self._ranges = {code: WHOLE for code in STICKS} | {HAT_X: (-1, 1), HAT_Y: (-1, 1)} | (ranges or {})
        self._axes = np.zeros(6)
        self._held: set[int] = set()
        self._rest = b""
        self.presses = 0

    def feed(self, raw: bytes) -> None:
        raw = self._rest + raw
        whole = len(raw) - len(raw) % EVENT.size
        self._rest = raw[whole:]
        for _, _, kind, code, value in EVENT.iter_unpack(raw[:whole]):
            self._event(kind, code, value)

    def _event(self, kind: int, code: int, value: int) -> None:
        if kind == EV_ABS and code in STICKS:
            axis, sign = STICKS[code]
            low, high = self._ranges[code]
            self._axes[axis] = sign * float(np.clip((2 * value - low - high) / (high - low), -1.0, 1.0))
        elif kind == EV_KEY and value == 0:
            self._held.discard(code)
        elif kind == EV_KEY and value == 1:  # 2 is a key's repeat
            self._held.add(code)
            self.presses += code == START
        elif kind == EV_SYN and code == SYN_DROPPED:  # events were lost, a release may be among them
            self._axes = np.zeros(6)
            self._held.clear()

    @property
    def axes(self) -> np.ndarray:
        return self._axes.copy() if SHOULDER in self._held else np.zeros(6)

    @property
    def grip(self) -> float:
        return float(SOUTH in self._held) - float(EAST in self._held)
