"""The SDK's doors: connections that end in time, error texts, and its side effects on the process undone.

Traps of xarm-python-sdk 1.18 that this file knows of: the constructor retries for minutes when nobody answers; it sets
the process-wide socket timeout; it prefers a local Unix socket whatever address was given; a servo call in a paused
state blocks for ever; its gripper calls may clear the arm's errors while they check a baud rate.
"""

from __future__ import annotations

import logging
import socket
import threading
from types import SimpleNamespace
from typing import Any, Literal

from xarm.core.comm import socket_port
from xarm.core.config.x_code import ControllerError, GripperError
from xarm.core.config.x_config import XCONF
from xarm.core.utils.log import logger as sdk_logger
from xarm.core.utils.log import origin_logger as sdk_printer
from xarm.wrapper import XArmAPI

from far_app.errors import RobotError
from far_app.scheduling import HARDWARE_PRIORITY, real_time_from_here
from hw.xarm7.settings import FAKE_PORT, XArmSettings

log = logging.getLogger(__name__)

Report = Literal["rich", "real", "none"]
"""What a connection is told unasked: everything five times a second, pose and state a hundred times, nothing."""
OK, HAS_ERROR, TIMEOUT, NOT_READY, NOT_CONNECTED = 0, 1, 3, 9, -1
"""Return codes of calls (xarm/x3/code.py)."""
SERVO_MODE = 1
MANUAL_MODE = 2
"""The arm gives way to a person's hands."""
ABLE = (1, 2)
"""States in which the arm follows: moving, ready."""
KEEPALIVE = ((socket.TCP_KEEPIDLE, 2), (socket.TCP_KEEPINTVL, 1), (socket.TCP_KEEPCNT, 3))

socket_port.socket = SimpleNamespace(**vars(socket) | {"setdefaulttimeout": lambda seconds: None})  # type: ignore[assignment]
"""The SDK's own view of the module: at every connection, also those that its threads make anew, it would set the whole
process's timeout to one second. Its sockets get theirs by themselves."""

sdk_logger.setLevel(logging.CRITICAL)  # it writes a line for every failed call; the driver says once what happened
sdk_printer.setLevel(logging.CRITICAL)


def connect(settings: XArmSettings, report: Report, timeout: float) -> XArmAPI:
    """A connection of its own. Raises RobotError when there is none within settings.connect_timeout seconds.

    timeout: seconds each call on it waits for its answer."""
    setattr(XCONF.SocketConf, "TCP_CONTROL_PORT", settings.port)  # noqa: B010 (the SDK declares it as a constant)
    made: list[XArmAPI | Exception] = []

    def make() -> None:
        real_time_from_here(HARDWARE_PRIORITY)  # the SDK's own threads, whoever connects: see far_app/scheduling.py
        try:
            made.append(
                XArmAPI(
                    settings.address, is_radian=True, forbid_uds=True, check_is_pause=False, baud_checkset=False,
                    enable_report=report != "none", report_type="rich" if report == "none" else report,
                )
            )  # fmt: skip
        except Exception as error:  # the SDK raises plain Exception
            made.append(error)

    thread = threading.Thread(target=make, name="xarm-connect", daemon=True)
    thread.start()
    thread.join(settings.connect_timeout)
    where = f"{settings.address}:{settings.port}"
    if not made:
        raise RobotError(
            f"the controller at {where} took the connection but did not answer within {settings.connect_timeout:g} s; "
            "is it an xArm controller, and has it finished starting? Look at its web page, then try again"
        )
    api = made[0]
    if isinstance(api, Exception):
        here = settings.address.startswith("127.") and settings.port != FAKE_PORT
        raise RobotError(
            f"no xArm controller at {where} ({api}); check its power and the cable, that this machine has an address "
            "in the same network, and the address in the rig file or after --host"
            + f" (a fake one (far fake-xarm) listens on port {FAKE_PORT}: {settings.address}:{FAKE_PORT})"
            * here
        )
    api.set_timeout(timeout)
    link = stream(api)
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in KEEPALIVE:
        link.setsockopt(socket.IPPROTO_TCP, option, value)
    return api


def stream(api: XArmAPI) -> socket.socket:
    """The socket of a connection's commands."""
    arm: Any = api._arm
    return arm._stream.com


def write_state_frame(api: XArmAPI, state: int) -> bool:
    """Put a set_state request on the wire now, without the connection's lock and without waiting for the answer. True
    when the system took it. For STOP: a lock held by a call that waits must not delay it."""
    arm: Any = api._arm
    if not api.connected:
        return False
    frame = bytes((0xFF, 0xF0, 0, arm.arm_cmd.get_protocol_identifier(), 0, 2, XCONF.UxbusReg.SET_STATE, state))
    return arm._stream.write(frame) == 0


def error_text(code: int) -> str:
    """An error of the controller in the SDK's words; empty for 0."""
    if code == 0:
        return ""
    error = ControllerError(code, status=0)
    title, advice = error.title["en"].strip(), error.description["en"].strip()
    return f"C{code}: {title}" + (f". {advice}" if advice else "")


def gripper_error_text(code: int) -> str:
    """The same for the gripper."""
    return f"gripper error G{code}: {GripperError(code, status=0).title['en'].strip()}" if code else ""


def check(code: int, what: str) -> None:
    """Raise RobotError for a call that failed."""
    if code != OK:
        meaning = {HAS_ERROR: "an error is active", TIMEOUT: "no answer in time", NOT_READY: "not ready to move",
                   NOT_CONNECTED: "not connected"}.get(code, "see the SDK's api codes")  # fmt: skip
        raise RobotError(f"the controller refused {what}: code {code} ({meaning}); look at the arm, then try again")
