"""Frames of the report ports: what the controller tells by itself.

30001 normal   5 Hz    145 bytes     adds errors, tool, load
30002 rich     5 Hz    574 bytes     adds the axis-angle pose, limits and much that stays zero here
30003 real   100 Hz    135 bytes     joints, pose, state and mode; no error code
"""

from __future__ import annotations

import struct

from hw.fake_xarm.arm import FakeArm
from hw.fake_xarm.protocol import floats

PORTS = {"normal": 30001, "rich": 30002, "real": 30003}
RATES = {"normal": 5.0, "rich": 5.0, "real": 100.0}
"""Reports a second."""
MOTORS = 0x7F
"""Seven motors with power and released brakes."""
VERSION = "7,7,XI1305,AC1304,v2.7.1"


def report(kind: str, arm: FakeArm) -> bytes:
    """One frame of a kind of report."""
    size = {"normal": 145, "rich": 574, "real": 135}[kind]
    frame = bytearray(size)
    struct.pack_into(">I", frame, 0, size)
    frame[4] = arm.mode << 4 | arm.state
    frame[7:35] = floats(arm.joints.tolist())
    frame[35:59] = floats([*arm.position.tolist(), *arm.rpy()])
    if kind == "real":
        return bytes(frame)
    power = MOTORS if arm.enabled else 0
    frame[87:91] = bytes((power, power, arm.error, arm.warning))
    frame[91:115] = floats(arm.tcp_offset)
    frame[115:131] = floats(arm.load)
    frame[131:133] = bytes((arm.sensitivity, 1))
    frame[133:145] = floats([0.0, 0.0, -1.0])
    if kind == "rich":
        _fill_rich(frame, arm)
    return bytes(frame)


def _fill_rich(frame: bytearray, arm: FakeArm) -> None:
    frame[145:147] = bytes((7, 7))
    frame[151:180] = VERSION.encode().ljust(29, b"\0")
    frame[181:201] = floats([1000.0, 1.0, 50000.0, 0.1, 1000.0])
    frame[201:221] = floats([20.0, 0.01, 20.0, 0.0001, 4.0])
    frame[221:229] = floats([2.3, 2.7])
    frame[315] = 1  # collision detection
    frame[482:494] = floats(arm.rotvec())
    struct.pack_into(">6h", frame, 496, 9999, -9999, 9999, -9999, 9999, -9999)
