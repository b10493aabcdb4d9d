"""A UFACTORY gripper behind the controller's RS485 line: registers of a G1 and of a G2.

A G1's position runs from −10 (closed) to 850 (open); a G2's travel in millimetres is a function of its position, and is
the SDK's affair. Frames are Modbus RTU without their checksum: device 8, function 3 reads, 16 writes.
"""

from __future__ import annotations

import struct

ENABLE, MODE, ERROR, RESET_ERROR = 0x0100, 0x0101, 0x000F, 0x0109
SPEED, TARGET, POSITION, G2_MOVE = 0x0303, 0x0700, 0x0702, 0x0C00
VERSION = {0x0801: 3, 0x0802: 4, 0x0803: 3}
STROKE_SECONDS = 0.6
"""From open to closed at full speed."""
OPEN = 850.0


class FakeGripper:
    """Closes on an object of a width when there is one."""

    def __init__(self) -> None:
        self.position = OPEN
        self.target = OPEN
        self.speed = 5000
        """As written: r/min for a G1, a G2's own unit."""
        self.force = 0
        """A G2's, 1 to 100."""
        self.enabled = False
        self.error = 0
        self.object: float | None = None
        """Position at which the fingers meet an object."""
        self.writes = 0
        """Positions asked for so far."""

    def advance(self, seconds: float) -> None:
        reach = OPEN / STROKE_SECONDS * seconds
        target = self.target if self.object is None else max(self.target, self.object)
        self.position += max(-reach, min(reach, target - self.position))

    def answer(self, frame: bytes) -> bytes:
        """The reply to a Modbus frame; empty when it is not one for a gripper."""
        if len(frame) < 6 or frame[0] != 8:
            return b""
        function, address, count = frame[1], *struct.unpack_from(">HH", frame, 2)
        if function == 3:
            return frame[:2] + bytes((2 * count,)) + self._read(address, count)
        if function == 16 and len(frame) >= 7 + 2 * count:
            self._write(address, frame[7 : 7 + 2 * count])
            return frame[:6]
        return b""

    def _read(self, address: int, count: int) -> bytes:
        if address == POSITION and count == 2:
            return struct.pack(">i", round(self.position))
        known = {ERROR: self.error, SPEED: self.speed, ENABLE: int(self.enabled), **VERSION}
        return struct.pack(f">{count}H", *(known.get(address + i, 0) for i in range(count)))

    def _write(self, address: int, words: bytes) -> None:
        if address == ENABLE:
            self.enabled = bool(words[-1])
        elif address == SPEED:
            self.speed = struct.unpack(">H", words)[0]
        elif address == RESET_ERROR:
            self.error = 0
        elif address == TARGET and self.enabled:
            self._go(struct.unpack(">i", words)[0])
        elif address == G2_MOVE and len(words) == 10:
            self.enabled = True
            _, self.speed, self.force, position = struct.unpack(">hhhi", words)
            self._go(position)

    def _go(self, position: int) -> None:
        self.target = float(max(-10, min(OPEN, position)))
        self.writes += 1
