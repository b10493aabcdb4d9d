"""`far doctor --rig FILE [--host ADDRESS]`: a rig file by itself, then against the controller it speaks of."""

from __future__ import annotations

import contextlib
import sys

import numpy as np

from far_app.errors import FarError
from far_app.tasks import TASKS
from hw.rig import at_address, load_rig
from hw.safety import violation


def check_rig(name: str, host: str) -> int:
    """Prints what it finds; exit status 1 when something is wrong or differs."""
    rig = at_address(load_rig(name), host)
    well = True

    def line(good: bool, subject: str, text: str, advice: str = "") -> None:
        nonlocal well
        well = well and good
        print(f"{'ok ' if good else 'BAD'}  {subject:<10} {text}{f'  → {advice}' if advice else ''}", flush=True)

    line(True, "file", f"{name}: {rig.name}, a {rig.robot} of an {rig.arm}")
    for task in ("", *(t for t in TASKS if rig.robot == "twin")):
        station = load_rig(name, task)
        outside = violation(np.array(station.start_position), station.safety)
        if outside or not task:
            where = f" at {task}'s station" if task else ""
            line(
                not outside, "start pose", f"{'outside' if outside else 'inside'} the workspace box{where}",
                f"by {outside:.3f} m: correct start_position or the box" if outside else "",
            )  # fmt: skip
    if rig.robot != "xarm":
        return 0 if well else 1
    speeds = f"{rig.safety.speed:g} m/s, home {min(rig.home.speed, rig.safety.speed):g} m/s"
    line(True, "limits", f"{speeds}, servo steps of at most {rig.xarm.servo_step * 1e3:g} mm")
    cameras = ", ".join(rig.cameras or ()) or "none, on purpose (cameras = [])"
    line(True, "cameras", cameras)
    if not rig.xarm.address:
        line(False, "address", "the file names none", "give xarm.address, or --host")
        return 1
    try:
        with contextlib.redirect_stdout(sys.stderr):  # the SDK prints when it is imported
            from hw.xarm7.compare import compare
        for found in compare(rig):
            line(found.good, found.subject, found.text, found.advice)
    except FarError as error:
        line(False, "controller", str(error))
    return 0 if well else 1
