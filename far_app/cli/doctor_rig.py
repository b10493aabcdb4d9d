"""`far doctor --rig FILE [--host ADDRESS]`: a rig file by itself, then against its cameras and its controller."""

from __future__ import annotations

import contextlib
import sys
import time

import numpy as np

from far_app.errors import FarError
from far_app.tasks import TASKS
from hw.camera_config import CameraConfig
from hw.rig import at_address, load_rig
from hw.safety import violation

WATCHED = 1.5
"""Seconds for which a camera is looked through."""
ENOUGH = 0.9
"""Share of the frames asked for that is enough."""


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
    if not rig.cameras:
        line(True, "cameras", "none, on purpose (cameras = [])")
    for view, config in (rig.cameras or {}).items():
        line(*camera(view, config))
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


def camera(name: str, config: CameraConfig) -> tuple[bool, str, str, str]:
    """Whether a camera gives what the rig asks for, its line's subject, text and advice."""
    from hw.camera_reader import CameraReader
    from hw.capture import capture_for

    subject = "camera"
    try:
        reader = CameraReader(name, capture_for(name, config), config)
        reader.start()
    except FarError as error:
        return False, subject, str(error).removeprefix("camera "), ""
    began = time.monotonic()
    time.sleep(WATCHED)
    seen, rate = reader.health(time.monotonic()), (reader.counts.frames - 1) / (time.monotonic() - began)
    reader.close()
    wrong = {kind: count for kind in ("dropped", "stale", "frozen") if (count := getattr(seen, kind))}
    good = rate >= ENOUGH * config.rate and not seen.frozen
    views = "; ".join(f"{view}: {framing.words()}" for view, framing in config.views(name).items())
    text = f"{config.width}×{config.height}, {rate:.0f} frames a second of {config.rate:g} asked for; {views}"
    text += "".join(f"; {count} {kind}" for kind, count in wrong.items())
    advice = "" if good else "give it a USB controller of its own, light, a smaller size, or format MJPG"
    return good, subject, text, advice
