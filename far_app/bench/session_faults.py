"""Faults that a session lives through: one session of real processes on the fake controller, struck again and again."""

from __future__ import annotations

import dataclasses
import logging
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from far_app.bench.fault_table import FAULTS, Bench, Fault
from far_app.bench.presser import Presser
from far_app.bench.recorded import attempts_in, lacking
from far_app.bench.servo_trace import servo_trace
from far_app.bench.waiting import came_true
from far_app.cli.options import RunOptions
from far_app.cli.stage import stage
from far_app.errors import FarError
from far_app.session.inbox import IntentInbox
from far_app.session.statistics import LoopStatistics
from far_app.session_states import Intent, State
from hw.fake_xarm.control import FakeXArm
from hw.fake_xarm.protocol import Function
from hw.rig import RIGS

log = logging.getLogger(__name__)

PORT = 15502
PATIENCE = 8.0
"""Seconds for a fault to be noticed, or for Resume to lead on."""
RESTING = (State.FAULT, State.STOPPED, State.PAUSED)
Shot = dict[str, Any]
"""One strike and what became of it; seconds and millimetres."""


def struck(
    names: list[str], shots: dict[str, list[Shot]], repeats: int, address: str, policy: str, until: float
) -> None:
    """Strike a session with these faults until each has so many shots, or the time (monotonic) is over. All need the
    same rig. What it adds to `shots` tells of the recording too."""
    new: list[tuple[str, Shot]] = []
    with tempfile.TemporaryDirectory(prefix="far-bench-") as folder:
        recordings = Path(folder) / "recordings"
        try:
            with running(address, policy, Path(folder), camera=FAULTS[names[0]].camera) as bench:
                for name in names:
                    for _ in range(repeats - len(shots.get(name, ()))):
                        if time.monotonic() < until:
                            new.append((name, once(bench, FAULTS[name])))
        finally:
            attempts = attempts_in(recordings) if new else []
            for name, shot in new:
                lacks = lacking(attempts, shot.pop("struck"))
                shots.setdefault(name, []).append(shot | {"lacking_s": lacks})


@contextmanager
def running(address: str, policy: str, folder: Path, camera: bool) -> Iterator[Bench]:
    """A session under way: headless for want of a page, with this program as its operator."""
    fake = FakeXArm.start(address, PORT)
    trouble = folder / "trouble"
    run = RunOptions(
        robot="xarm", rig=str(seeing_rig(folder, trouble)) if camera else None, host=f"{address}:{PORT}", policy=policy,
        headless=True, rerun=False, judge_wait=0.0, recordings=folder / "recordings", max_attempts=1_000_000,
        full_speed=True,
    )  # fmt: skip
    try:
        with stage(run) as made:
            attended = dataclasses.replace(made, options=dataclasses.replace(run, headless=False))
            inbox, statistics = IntentInbox(), LoopStatistics()
            presser = Presser(made.folder)
            with attended.session(attended.writer(), inbox, statistics) as session:
                thread = threading.Thread(target=session.run, name="session", daemon=True)
                thread.start()
                yield Bench(
                    fake=fake, stage=attended, session=session, inbox=inbox, presser=presser, camera=trouble
                )  # fmt: skip
                inbox.put(Intent.QUIT)
                thread.join(10.0)
            presser.close()
    finally:
        fake.close()


def seeing_rig(folder: Path, trouble: Path) -> Path:
    """The shipped rig with the paper's camera, synthetic: its file."""
    file = folder / "rig.toml"
    text = (RIGS / "xarm7.toml").read_text().replace("cameras = []\n", "")
    file.write_text(
        f'{text}\n[camera.front]\ndevice = "synthetic:{trouble}"\nwidth = 2560\nheight = 720\neye = "left"\n'
    )
    return file


def once(bench: Bench, fault: Fault) -> Shot:
    """One strike in the middle of a motion, and the way out of it."""
    deadline = time.monotonic() + 3 * PATIENCE
    while not came_true(lambda: bench.state is State.RUNNING and bench.recorded > 15, 3.0):
        if time.monotonic() > deadline:
            raise FarError(f"the arm does not move: {bench.state}, {bench.session.board.reason}")
        if bench.state in RESTING:  # trouble of the machine's own, in between
            log.warning("between faults: %s", bench.session.board.reason)
            bench.inbox.put(Intent.RESUME)
    bench.fake.received()
    bench.press = None
    bench.struck = time.monotonic()
    fault.strike(bench)
    at = bench.struck
    told = came_true(lambda: bench.state in RESTING, PATIENCE if fault.latches else fault.seconds)
    told_after = time.monotonic() - at
    time.sleep(0.3)
    received = bench.fake.received()
    words = bench.session.board.reason if told else ""
    fault.heal(bench)
    targets = [r for r in received if r["function"] == Function.MOVE_SERVO_CART_AA]
    trace = servo_trace(targets, bench.stage.rig.safety)
    shot: Shot = {
        "struck": at, "held": told, "told_s": told_after if told else None, "words": words, "outside": trace.outside,
        "hold_s": max(0.0, trace.last_motion - at) if told else None, "step_mm": trace.largest_step,
    }  # fmt: skip
    if (press := bench.press) is not None:
        stops = [r["at"] for r in received if r["function"] == Function.SET_STATE and r["argument"] == 4]
        shot["stop_s"] = stops[0] - press.pressed if stops else None
        shot["heard_s"] = stops[0] - press.heard if stops and press.heard is not None else None
        shot["floor_s"] = press.floor
    if told:
        return shot | resume(bench)
    return shot | {"resumed": came_true(lambda: bench.state is State.RUNNING, 3.0), "first_mm": trace.step_after_still}


def resume(bench: Bench) -> Shot:
    """The operator looks, then presses Resume, more than once where it is refused."""
    stood = np.array(bench.fake.state()["position"])
    bench.fake.received()
    deadline = time.monotonic() + PATIENCE
    while bench.state in RESTING and time.monotonic() < deadline:
        bench.inbox.put(Intent.RESUME)
        came_true(lambda: bench.state not in RESTING, 2.0)
        came_true(lambda: bench.state in RESTING, 0.2)
    resumed = came_true(lambda: bench.state is State.RUNNING, PATIENCE)
    trace = servo_trace(bench.fake.servo_targets(), bench.stage.rig.safety)
    return {
        "resumed": resumed, "first_mm": float(np.linalg.norm(trace.first - stood)) if resumed else None,
        "step_after_mm": trace.largest_step,
    }  # fmt: skip
