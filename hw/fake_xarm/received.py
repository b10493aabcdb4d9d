"""What the fake controller received, each request stamped as it came off the wire: a test sees the orders by it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from hw.fake_xarm.commands import SERVO, servo_pose
from hw.fake_xarm.protocol import Function, Request

KEPT = 400_000
"""Requests remembered."""
POLLED = (Function.GET_STATE, Function.GET_ERROR, Function.GET_CMDNUM, Function.RS485)
"""Requests that are not remembered: they move nothing."""


@dataclass(frozen=True, kw_only=True)
class Received:
    """One request as it came off the wire."""

    at: float
    """Monotonic seconds; the same clock in every process of a machine."""
    connection: int
    function: int
    argument: int
    """First byte of the data: the state or mode asked for."""
    pose: tuple[float, ...] = ()
    """Servo targets: x, y, z in millimetres and the quaternion (xyzw)."""


class ReceivedLog:
    """The newest requests, until somebody takes them."""

    def __init__(self) -> None:
        self._kept: deque[Received] = deque(maxlen=KEPT)

    def remember(self, request: Request, connection: int, arrived: float) -> None:
        if request.function in POLLED:
            return
        pose: tuple[float, ...] = ()
        if request.function in SERVO[:2] and len(request.payload) >= 24:
            position, quaternion = servo_pose(request)
            pose = (*position.tolist(), *quaternion.tolist())
        first = request.payload[-1] if request.function == Function.MOTION_EN else (request.payload or b"\0")[0]
        self._kept.append(
            Received(at=arrived, connection=connection, function=request.function, argument=first, pose=pose)
        )

    def take(self) -> list[Received]:
        """All of them, oldest first; they are forgotten here."""
        taken = list(self._kept)
        self._kept.clear()
        return taken
