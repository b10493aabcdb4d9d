"""What each request does to the arm, and what is answered."""

from __future__ import annotations

import struct

import numpy as np

from far_app.motion import quat_from_rotvec, quat_multiply
from hw.fake_xarm.arm import ArmState, FakeArm
from hw.fake_xarm.gripper import FakeGripper
from hw.fake_xarm.protocol import Bits, Function, Request, floats, read_floats, response
from hw.fake_xarm.reports import VERSION

SERVO = (Function.MOVE_SERVO_CART, Function.MOVE_SERVO_CART_AA, Function.MOVE_SERVO_JOINT)
BAUD_2M = 11
"""Index of 2,000,000 baud in the SDK's table."""


def answer(request: Request, arm: FakeArm, gripper: FakeGripper, now: float) -> bytes:
    """Do it; the response's frame."""
    try:
        payload = _do(request, arm, gripper, now)
    except (struct.error, IndexError):
        payload = None
    bits = Bits.OK if payload is not None else Bits.INVALID
    if arm.error:
        bits |= Bits.ERROR
    elif arm.warning:
        bits |= Bits.WARNING
    if arm.state in (ArmState.STOPPED, ArmState.CONFIG_CHANGED):
        bits |= Bits.NOT_READY
    return response(request, bits, payload or b"")


def servo_pose(request: Request) -> tuple[np.ndarray, np.ndarray]:
    """Position (mm) and orientation (xyzw) of a Cartesian servo request."""
    values = np.array(read_floats(request.payload, 6))
    if request.function == Function.MOVE_SERVO_CART_AA:
        return values[:3], quat_from_rotvec(values[3:])
    x, y, z = (quat_from_rotvec(axis * angle) for axis, angle in zip(np.eye(3), values[3:], strict=True))
    return values[:3], quat_multiply(z, quat_multiply(y, x))


def _do(request: Request, arm: FakeArm, gripper: FakeGripper, now: float) -> bytes | None:
    """The response's data; None for what this controller does not know."""
    payload = request.payload
    match request.function:
        case Function.GET_VERSION:
            return VERSION.encode().ljust(40, b"\0")
        case Function.GET_ROBOT_SN:
            return b"XI130500000000\0AC130400000000\0".ljust(40, b"\0")
        case Function.MOVE_SERVO_CART | Function.MOVE_SERVO_CART_AA:
            arm.servo(*servo_pose(request), now)
            return bytes(2)
        case Function.MOVE_SERVO_JOINT:
            return bytes(2)
        case Function.MOTION_EN:
            arm.enabled = bool(payload[1]) and not arm.emergency
            return bytes(2)
        case Function.SET_STATE:
            arm.set_state(payload[0])
            return bytes(2)
        case Function.SET_MODE:
            arm.set_mode(payload[0])
            return bytes(2)
        case Function.CLEAN_ERR:
            arm.clear_error()
            return bytes(2)
        case Function.CLEAN_WAR:
            arm.warning = 0
            return bytes(2)
        case Function.GET_STATE:
            return bytes((arm.state,))
        case Function.GET_ERROR:
            return bytes((arm.error, arm.warning))
        case Function.GET_TCP_POSE:
            return floats([*arm.position.tolist(), *arm.rpy()])
        case Function.GET_TCP_POSE_AA:
            return floats([*arm.position.tolist(), *arm.rotvec()])
        case Function.GET_JOINTS:
            return floats(arm.joints.tolist())
        case Function.SET_TCP_OFFSET:
            arm.tcp_offset = read_floats(payload, 6)
            arm.configured()
            return bytes(2)
        case Function.SET_LOAD:
            arm.load = read_floats(payload, 4)
            arm.configured()
            return bytes(2)
        case Function.SET_COLLISION_SENSITIVITY:
            arm.sensitivity = payload[0]
            arm.configured()
            return bytes(2)
        case Function.RS485:
            return bytes((payload[0],)) + gripper.answer(payload[1:])
        case Function.TOOL_READ_16:
            return struct.pack(">I", BAUD_2M)
        case Function.TOOL_WRITE_16:
            return bytes(2)
        case Function.GET_CMDNUM:
            return bytes(2)
        case Function.CHECK_VERIFY | Function.IS_JOINT_LIMIT | Function.IS_TCP_LIMIT:
            return bytes(1)
        case Function.SAVE_CONF:
            return bytes(2)
    return None
