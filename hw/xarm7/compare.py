"""A rig file against the controller it speaks of: what differs, changing nothing. `far doctor --rig` prints it.

Reads only: no motion, no mode, no error cleared, no setting written.
"""

from __future__ import annotations

import contextlib
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import cast

import numpy as np
from xarm.wrapper import XArmAPI

from hw.rig import RigConfig
from hw.safety import violation
from hw.xarm7.sdk import OK, connect, error_text, gripper_error_text
from hw.xarm7.telling import Telling
from hw.xarm7.units import MM, offset_to_wire

SAME_LENGTH, SAME_ANGLE, SAME_MASS = 0.5, 0.005, 0.02
"""Millimetres, radians and kilograms that count as the same."""
OLDEST = (1, 11, 0)
"""Firmware from which everything used here is there (vendor's release notes, through the SDK)."""
LIMITS = ((-360, 360), (-118, 120), (-360, 360), (-11, 225), (-360, 360), (-97, 180), (-360, 360))
"""Joint limits, degrees (vendor's manual)."""
REPORTS = 80.0
"""Fast reports a second that are enough."""


@dataclass(frozen=True, kw_only=True)
class Compared:
    """One line of the comparison."""

    subject: str
    good: bool
    text: str
    advice: str = ""


def compare(rig: RigConfig) -> Iterator[Compared]:
    """Line by line, as they are found. Raises RobotError where no controller answers."""
    with contextlib.redirect_stdout(sys.stderr):
        slow = connect(rig.xarm, "rich", 1.0)
        fast = connect(rig.xarm, "real", 1.0)
    try:
        telling = Telling(slow, fast)
        now = time.monotonic()
        told = telling.wait_fast(now, 2.0)
        if told is None or not telling.wait_slow(now, 2.0):
            yield Compared(
                subject="reports", good=False, text="none came on ports 30002 and 30003",
                advice="look for a firewall, and for other programs that use up the controller's connections",
            )  # fmt: skip
            return
        for line in (_firmware, _errors, _mode, _tool, _load, _sensitivity):
            yield line(rig, slow)
        outside = violation(told.pose.position, rig.safety)
        yield Compared(
            subject="hand", good=outside == 0.0,
            text=f"at ({', '.join(f'{x:.3f}' for x in told.pose.position)}) m, "
            + (f"{outside:.3f} m outside the workspace box" if outside else "inside the workspace box"),
            advice="move it into the box by hand, or correct the box" if outside else "",
        )  # fmt: skip
        yield _joints(told.joints)
        yield _round_trip(rig, slow)
        yield _report_rate(telling)
        if rig.xarm.gripper.kind != "none":
            yield _gripper(rig, fast)
    finally:
        slow.disconnect()
        fast.disconnect()


def _firmware(rig: RigConfig, api: XArmAPI) -> Compared:
    good = api.axis == 7 and api.version_number >= OLDEST
    return Compared(
        subject="controller", good=good, text=f"firmware {'.'.join(map(str, api.version_number))}, {api.axis} axes",
        advice="" if good else f"an xArm7 with firmware {'.'.join(map(str, OLDEST))} or newer is needed",
    )  # fmt: skip


def _errors(rig: RigConfig, api: XArmAPI) -> Compared:
    code, warning = api.error_code, api.warn_code
    text = error_text(code) or (f"warning {warning}" if warning else "none")
    return Compared(
        subject="errors", good=code == 0, text=text,
        advice="look at the arm; `far run` leaves it until you press Resume" if code else "",
    )  # fmt: skip


def _mode(rig: RigConfig, api: XArmAPI) -> Compared:
    return Compared(
        subject="mode", good=True, text=f"mode {api.mode}, state {api.state}; a run enters mode 1 by itself"
    )


def _tool(rig: RigConfig, api: XArmAPI) -> Compared:
    wanted, there = offset_to_wire(rig.xarm.tcp_offset), list(api.tcp_offset)
    good = np.allclose(there[:3], wanted[:3], atol=SAME_LENGTH) and np.allclose(there[3:], wanted[3:], atol=SAME_ANGLE)
    return _differs("tool", good, f"{_row(wanted)} (mm, rad)", _row(there), "xarm.tcp_offset")


def _load(rig: RigConfig, api: XArmAPI) -> Compared:
    mass, center = api.tcp_load
    wanted = [c * MM for c in rig.xarm.load_center]
    good = abs(mass - rig.xarm.load_mass) < SAME_MASS and np.allclose(center, wanted, atol=10 * SAME_LENGTH)
    there = f"{mass:g} kg at {_row(center)}"
    return _differs("load", good, f"{rig.xarm.load_mass:g} kg at {_row(wanted)} (mm)", there, "xarm.load_mass")


def _sensitivity(rig: RigConfig, api: XArmAPI) -> Compared:
    least, there = rig.xarm.collision_sensitivity, api.collision_sensitivity
    good = there >= least
    return Compared(
        subject="collision", good=good, text=f"sensitivity {there}, the rig asks for at least {least}",
        advice="" if good else "set it in UFACTORY Studio; no program here ever changes it",
    )  # fmt: skip


def _joints(joints: np.ndarray) -> Compared:
    degrees = np.degrees(joints)
    near = [f"J{i + 1} {d:.0f}°" for i, d in enumerate(degrees) if not LIMITS[i][0] + 5 < d < LIMITS[i][1] - 5]
    return Compared(
        subject="joints", good=not near, text=f"near their limits: {', '.join(near)}" if near else "away from limits",
        advice="move the arm by hand until no joint is within 5° of its end" if near else "",
    )  # fmt: skip


def _round_trip(rig: RigConfig, api: XArmAPI) -> Compared:
    times = []
    for _ in range(100):
        began = time.monotonic()
        api.get_state()
        times.append(1e3 * (time.monotonic() - began))
        time.sleep(0.005)
    median, worst = statistics.median(times), max(times)
    good = median < 1e3 * rig.xarm.latency_limit
    return Compared(
        subject="network", good=good, text=f"a call takes {median:.1f} ms (median of 100), {worst:.1f} at worst",
        advice="" if good and worst < 50 else "use a cable of its own between this machine and the controller",
    )  # fmt: skip


def _report_rate(telling: Telling) -> Compared:
    seen, began = set[float](), time.monotonic()
    while time.monotonic() - began < 1.0:
        if telling.newest is not None:
            seen.add(telling.newest.at)
        time.sleep(0.002)
    good = len(seen) >= REPORTS
    return Compared(
        subject="reports", good=good, text=f"{len(seen)} a second from port 30003",
        advice="" if good else "100 are usual; look at the network and at this machine's load",
    )  # fmt: skip


def _gripper(rig: RigConfig, api: XArmAPI) -> Compared:
    read: Callable[[], object] = (
        api.get_gripper_g2_position if rig.xarm.gripper.kind == "g2" else api.get_gripper_position
    )
    code, position = cast(tuple[int, float | None], read())
    error = gripper_error_text(api._arm.gripper_error_code)
    good = code == OK and position is not None and not error
    return Compared(
        subject="gripper", good=good,
        text=f"{rig.xarm.gripper.kind} at {position}" if good else error or f"does not answer (code {code})",
        advice="" if good else "check its cable, its kind in the rig file and its baud rate in UFACTORY Studio",
    )  # fmt: skip


def _differs(subject: str, good: bool, wanted: str, there: str, setting: str) -> Compared:
    return Compared(
        subject=subject, good=bool(good), text=f"{wanted} in both" if good else f"rig {wanted}, controller {there}",
        advice="" if good else f"correct {setting}, or let `far run` set the controller to the rig's (it will)",
    )  # fmt: skip


def _row(values: list[float]) -> str:
    return "(" + ", ".join(f"{v:g}" for v in np.round(values, 4)) + ")"
