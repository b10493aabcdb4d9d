"""Metres, radians and quaternions on our side; millimetres, roll-pitch-yaw and axis-angle on the wire.

Near "gripper down" both wire forms of an orientation wrap by a whole turn between neighbouring poses, so nothing is
ever interpolated in them. Base frame on both sides.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from far_app.motion import quat_from_rotvec, quat_multiply, rotvec_from_quat
from far_app.types import Pose

MM = 1000.0
"""Millimetres a metre."""
_AXES = np.eye(3)


def pose_from_rpy(values: Sequence[float] | Float[np.ndarray, "6"]) -> Pose:
    """A reported pose: x, y, z in mm; roll, pitch, yaw in radians, R = Rz(yaw) Ry(pitch) Rx(roll)."""
    x, y, z = (quat_from_rotvec(axis * angle) for axis, angle in zip(_AXES, values[3:6], strict=True))
    return Pose(position=np.asarray(values[:3]) / MM, quaternion=quat_multiply(z, quat_multiply(y, x)))


def axis_angle(pose: Pose) -> list[float]:
    """A pose for set_servo_cartesian_aa: mm and a rotation vector in radians."""
    return [*(pose.position * MM).tolist(), *rotvec_from_quat(pose.quaternion).tolist()]


def offset_to_wire(offset: Sequence[float]) -> list[float]:
    """A tool offset, metres and radians, for the controller."""
    return [*(value * MM for value in offset[:3]), *offset[3:]]


def opening(position: float, open_: float, closed: float) -> float:
    """A gripper's position as its opening: 0 closed, 1 open."""
    return float(np.clip((position - closed) / (open_ - closed), 0.0, 1.0))


def gripper_position(command: Float[np.ndarray, ""] | float, open_: float, closed: float) -> float:
    """The position for a command in [−1, 1]: −1 opens, +1 closes."""
    return closed + (1.0 - float(np.clip(command, -1.0, 1.0))) / 2.0 * (open_ - closed)
