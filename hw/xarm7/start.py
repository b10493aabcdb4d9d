"""From any state to servo mode: clear what the operator has acknowledged, enable, configure, switch, prime.

The order is the vendor's: a change of tool or load throws the arm out of its mode, so all configuration comes before
the mode; mode 0 lies between any two others; the first servo target of an arm that was not primed is violent.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

import numpy as np
from xarm.wrapper import XArmAPI

from far_app.errors import RobotError
from far_app.types import Pose
from hw.xarm7.sdk import ABLE, MANUAL_MODE, SERVO_MODE, check, error_text
from hw.xarm7.settings import XArmSettings
from hw.xarm7.telling import Telling
from hw.xarm7.units import MM, axis_angle, offset_to_wire

log = logging.getLogger(__name__)

PATIENCE = 2.0
"""Seconds for a report that shows what was asked for."""
PRIMES = 5
"""Servo targets at the present pose before the first that moves."""
SAME = 1e-3
"""Millimetres, radians or kilograms within which the controller's configuration is the rig's."""


def clear_errors(api: XArmAPI, telling: Telling) -> None:
    """Only ever called for an operator's Resume. Raises RobotError when an error stays (a pressed emergency stop)."""
    api.clean_error()
    api.clean_warn()
    now = time.monotonic()
    if not telling.wait_slow(now, PATIENCE):
        raise RobotError("the controller sends no reports; check the cable, then press Resume again")
    if telling.error:
        raise RobotError(f"the controller still reports {error_text(telling.error)} After that press Resume again")


def configure(api: XArmAPI, settings: XArmSettings) -> None:
    """Tool offset and load as the rig file says, until the reports show them; the collision sensitivity is looked at
    and left alone. Throws the arm out of its mode where something changes."""
    if api.collision_sensitivity < settings.collision_sensitivity:
        raise RobotError(
            f"the controller's collision sensitivity is {api.collision_sensitivity}, the rig asks for at least "
            f"{settings.collision_sensitivity}; set it in UFACTORY Studio (this program never changes it)"
        )
    offset, load = offset_to_wire(settings.tcp_offset), [settings.load_mass, *(c * MM for c in settings.load_center)]

    def shown() -> list[float]:
        mass, center = api.tcp_load
        return [*api.tcp_offset, mass, *center]

    if np.allclose(shown(), [*offset, *load], atol=SAME):
        return
    log.info("tool offset and load %s → %s", shown(), [*offset, *load])
    api.set_tcp_offset(offset, is_radian=True, wait=False)  # their codes tell of the mode they end, not of success
    api.set_tcp_load(load[0], load[1:], wait=False)
    deadline = time.monotonic() + PATIENCE
    while not np.allclose(shown(), [*offset, *load], atol=SAME):
        if time.monotonic() > deadline:
            raise RobotError(
                f"the controller did not take the rig's tool offset and load {[*offset, *load]} (mm, rad, kg) within "
                f"{PATIENCE:g} s, it reports {shown()}; set them in UFACTORY Studio"
            )
        time.sleep(0.01)


def enter_servo_mode(api: XArmAPI, telling: Telling, settings: XArmSettings, halted: Callable[[], bool]) -> Pose:
    """Enable, configure, switch, prime; returns the pose the arm stands at and was primed with. The arm does not move.
    Raises RobotError where the controller does not follow, or `halted` turned true."""
    check(api.motion_enable(True), "to enable the motors")
    configure(api, settings)
    for mode in (0, SERVO_MODE):
        if halted():
            raise RobotError("STOP was pressed while the arm was made ready; look, then press Resume again")
        check(api.set_mode(mode), f"mode {mode}")
        check(api.set_state(0), "to become ready")
    here = _wait_able(telling)
    wire, period = axis_angle(here), 0.01
    for _ in range(PRIMES):
        check(api.set_servo_cartesian_aa(wire, is_radian=True), "its own pose as a servo target")
        time.sleep(period)
    return here


def enter_manual_mode(api: XArmAPI, telling: Telling, halted: Callable[[], bool]) -> None:
    """The mode in which a person leads the arm by hand: its load must be the rig's (`configure` saw to that), or it
    sinks. Raises RobotError where the controller does not follow, or `halted` turned true."""
    for mode in (0, MANUAL_MODE):
        if halted():
            raise RobotError("STOP was pressed while the arm was made ready; look, then press Resume again")
        check(api.set_mode(mode), f"mode {mode}")
        check(api.set_state(0), "to become ready")
    _wait_able(telling, MANUAL_MODE, "manual mode")


def _wait_able(telling: Telling, mode: int = SERVO_MODE, name: str = "servo mode") -> Pose:
    """The pose, once a fresh report shows the mode and a state that follows."""
    deadline = time.monotonic() + PATIENCE
    told, after = None, time.monotonic()
    while time.monotonic() < deadline:
        told = telling.wait_fast(after, PATIENCE)
        if told is not None and told.mode == mode and told.state in ABLE:
            return told.pose
        after = told.at if told is not None else after
    shown = f"mode {told.mode}, state {told.state}" if told is not None else "nothing"
    raise RobotError(
        f"the controller did not enter {name} within {PATIENCE:g} s (it reports {shown}, needed: mode "
        f"{mode}, state 1 or 2); look at it in UFACTORY Studio, then press Resume again"
    )
