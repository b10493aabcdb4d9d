"""`far bench faults`: everything that can go wrong with a real arm, again and again, on the fake controller.

For each fault: milliseconds until the last servo target that moved (then the arm holds), the largest servo step, how
many targets left the workspace box, what the operator read, whether Resume led on, and how far its first target lay
from where the arm stood. One session through the real processes, and the recording it left; what ends or freezes a
process in runs of their own (far_app/bench/whole_runs.py).
"""

from __future__ import annotations

import dataclasses
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from far_app.bench.fault_table import FAULTS, Bench, Fault, hasten
from far_app.bench.report import keep, write
from far_app.bench.servo_trace import servo_trace
from far_app.bench.waiting import came_true
from far_app.bench.whole_runs import WHOLE_RUNS, whole_runs
from far_app.cli.options import RunOptions
from far_app.cli.stage import stage
from far_app.errors import FarError
from far_app.recording.inspect import inspect_session
from far_app.session.inbox import IntentInbox
from far_app.session.statistics import LoopStatistics, percentiles
from far_app.session_states import Intent, State
from hw.fake_xarm.control import FakeXArm
from hw.fake_xarm.protocol import Function

PORT = 15502
PATIENCE = 8.0
"""Seconds for a fault to be noticed, or for Resume to lead on."""


@dataclass(frozen=True, kw_only=True)
class FaultOptions:
    """Faults of a real arm on the fake controller, each many times."""

    json: Path | None = None
    """Write the table here too."""
    repeats: int = 20
    whole_runs: int = 0
    """Repeats of the faults that need a run of their own, some ten seconds each; as many as of the others when 0."""
    only: tuple[str, ...] = ()
    """Names of faults; all by default."""
    address: str = "127.0.0.77"
    """Loopback address for the fake controller; the next one is used too."""
    policy: str = "test:wander"


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(FaultOptions, args=list(arguments), prog="far bench faults")
    known = (*FAULTS, *WHOLE_RUNS)
    names = options.only or known
    if unknown := [n for n in names if n not in known]:
        raise FarError(f"unknown fault {', '.join(unknown)}; choose from: {', '.join(known)}")
    report: dict[str, Any] = {"repeats": options.repeats}
    if chosen := [n for n in names if n in FAULTS]:
        report |= measure(options, chosen)
    for name in (n for n in names if n in WHOLE_RUNS):
        row_ = whole_runs(name, options.whole_runs or options.repeats, options.address, options.policy)
        report.setdefault("faults", {})[name] = row_
        keep(report, options.json)
    write(report, options.json)
    return 0


def measure(options: FaultOptions, names: list[str]) -> dict[str, Any]:
    """All faults in one session."""
    with tempfile.TemporaryDirectory(prefix="far-bench-") as recordings, running(options, Path(recordings)) as bench:
        rows: dict[str, Any] = {}
        for name in names:
            rows[name] = row([once(bench, FAULTS[name]) for _ in range(options.repeats)])
            keep({"repeats": options.repeats, "faults": rows}, options.json)
        bench.inbox.put(Intent.QUIT)
        came_true(lambda: bench.state is State.FINISHED, 10.0)
        time.sleep(1.0)
        (folder,) = Path(recordings).iterdir()
        found = inspect_session(folder)
        attempts = sum(len(trial.attempts) for trial in found.trials)
        return {
            "faults": rows,
            "recording": {"sound": found.sound, "attempts": attempts, "problems": list(found.problems)},
        }


@contextmanager
def running(options: FaultOptions, recordings: Path) -> Iterator[Bench]:
    """A session under way: headless for want of a page, with this program as its operator."""
    fake = FakeXArm.start(options.address, PORT)
    hasten(fake)
    run = RunOptions(
        robot="xarm", host=f"{options.address}:{PORT}", policy=options.policy, headless=True, rerun=False,
        judge_wait=0.0, recordings=recordings, max_attempts=1_000_000, full_speed=True,
    )  # fmt: skip
    try:
        with stage(run) as made:
            attended = dataclasses.replace(made, options=dataclasses.replace(run, headless=False))
            inbox, statistics = IntentInbox(), LoopStatistics()
            with attended.session(attended.writer(), inbox, statistics) as session:
                thread = threading.Thread(target=session.run, name="session", daemon=True)
                thread.start()
                yield Bench(fake=fake, stage=attended, session=session, inbox=inbox)
                inbox.put(Intent.QUIT)
                thread.join(10.0)
    finally:
        fake.close()


def once(bench: Bench, fault: Fault) -> dict[str, Any]:
    """One strike in the middle of a motion, and the way out of it."""
    moving = came_true(lambda: bench.state is State.RUNNING and bench.session._recorded > 15, 20.0)
    if not moving:
        raise FarError(f"the arm does not move: {bench.state}, {bench.session.board.reason}")
    bench.fake.received()
    bench.struck = time.monotonic()
    fault.strike(bench)
    struck = bench.struck
    noticed = not fault.latches or came_true(lambda: bench.state in (State.FAULT, State.STOPPED), PATIENCE)
    noticed_after = time.monotonic() - struck
    words = bench.session.board.reason
    time.sleep(0.3 if fault.latches else fault.seconds)
    received = bench.fake.received()
    fault.heal(bench.fake)
    bench.relieve()
    targets = [r for r in received if r["function"] == Function.MOVE_SERVO_CART_AA]
    trace = servo_trace(targets, bench.stage.rig.safety)
    stops = [r["at"] for r in received if r["function"] == Function.SET_STATE and r["argument"] == 4]
    shot = {
        "noticed": noticed, "noticed_s": noticed_after, "words": words, "outside": trace.outside,
        "hold_s": max(0.0, trace.last_motion - struck) if fault.latches else 0.0,
        "step_mm": trace.largest_step, "stop_s": stops[0] - struck if stops else None,
    }  # fmt: skip
    if fault.latches or bench.state in (State.FAULT, State.STOPPED):
        return shot | {"words": bench.session.board.reason or words} | resume(bench)
    return shot | {"resumed": True, "first_mm": 0.0}


def resume(bench: Bench) -> dict[str, Any]:
    """The operator looks, then presses Resume, more than once where it is refused."""
    stood = np.array(bench.fake.state()["position"])
    deadline = time.monotonic() + PATIENCE
    while bench.state in (State.FAULT, State.STOPPED) and time.monotonic() < deadline:
        bench.inbox.put(Intent.RESUME)
        came_true(lambda: bench.state not in (State.FAULT, State.STOPPED), 2.0)
    came_true(lambda: bench.state is State.RUNNING, PATIENCE)
    trace = servo_trace(bench.fake.servo_targets(), bench.stage.rig.safety)
    return {
        "resumed": bench.state is State.RUNNING, "first_mm": float(np.linalg.norm(trace.first - stood)),
        "step_after_mm": trace.largest_step,
    }  # fmt: skip


def row(shots: list[dict[str, Any]]) -> dict[str, Any]:
    """A fault's line of the table."""
    stops = [s["stop_s"] for s in shots if s["stop_s"] is not None]
    return {
        "times": len(shots),
        "noticed": sum(s["noticed"] for s in shots),
        "noticed_ms": percentiles([s["noticed_s"] for s in shots], 1e3),
        "hold_ms": percentiles([s["hold_s"] for s in shots], 1e3),
        "stop_frame_ms": percentiles(stops, 1e3) if stops else None,
        "largest_step_mm": round(max(max(s["step_mm"], s.get("step_after_mm", 0.0)) for s in shots), 3),
        "targets_outside_box": sum(s["outside"] for s in shots),
        "resumed": sum(s["resumed"] for s in shots),
        "first_target_after_mm": round(max(s["first_mm"] for s in shots), 3),
        "operator_read": shots[-1]["words"],
    }
