"""Frames of the command port (502).

    request    u16 transaction | u16 protocol | u16 length | u8 function | data
    response   u16 transaction | u16 protocol | u16 length | u8 function | u8 state bits | data

u16 big-endian; floats and 32-bit integers in the data little-endian.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag

HEADER = struct.Struct(">HHH")


class Function(IntEnum):
    """The requests this controller does something about."""

    GET_VERSION = 1
    GET_ROBOT_SN = 2
    CHECK_VERIFY = 3
    MOTION_EN = 11
    SET_STATE = 12
    GET_STATE = 13
    GET_CMDNUM = 14
    GET_ERROR = 15
    CLEAN_ERR = 16
    CLEAN_WAR = 17
    SET_MODE = 19
    MOVE_SERVO_JOINT = 29
    MOVE_SERVO_CART = 30
    SET_TCP_OFFSET = 35
    SET_LOAD = 36
    SET_COLLISION_SENSITIVITY = 37
    SAVE_CONF = 40
    GET_TCP_POSE = 41
    GET_JOINTS = 42
    IS_JOINT_LIMIT = 45
    IS_TCP_LIMIT = 46
    GET_TCP_POSE_AA = 91
    MOVE_SERVO_CART_AA = 93
    RS485 = 124
    TOOL_WRITE_16 = 127
    TOOL_READ_16 = 128


class Bits(IntFlag):
    """State bits of every response."""

    OK = 0
    INVALID = 0x08
    NOT_READY = 0x10
    WARNING = 0x20
    ERROR = 0x40


@dataclass(frozen=True, kw_only=True)
class Request:
    transaction: int
    protocol: int
    function: int
    payload: bytes


def take_request(buffer: bytearray) -> Request | None:
    """The first whole request, removed from the buffer; None while none is whole."""
    if len(buffer) < HEADER.size:
        return None
    transaction, protocol, length = HEADER.unpack_from(buffer)
    end = HEADER.size + length
    if len(buffer) < end:
        return None
    body = bytes(buffer[HEADER.size : end])
    del buffer[:end]
    return Request(transaction=transaction, protocol=protocol, function=body[0] if body else 0, payload=body[1:])


def response(request: Request, bits: Bits, payload: bytes = b"") -> bytes:
    """The answer to a request."""
    head = HEADER.pack(request.transaction, request.protocol, len(payload) + 2)
    return head + bytes((request.function, int(bits))) + payload


def floats(values: list[float]) -> bytes:
    """fp32, little-endian."""
    return struct.pack(f"<{len(values)}f", *values)


def read_floats(payload: bytes, count: int) -> list[float]:
    return list(struct.unpack_from(f"<{count}f", payload))
