"""`far bench faults`: everything that can go wrong with a real arm, again and again, on the fake controller.

For each fault: milliseconds until the last servo target that moved (then the arm holds), the largest servo step, how
many targets left the workspace box, what the operator read, whether Resume led on, and how far its first target lay
from where the arm stood. One session through the real processes, and the recording it left; the app's and the hw
server's SIGKILL in sessions of their own (far_app/bench/killed.py).
"""

from __future__ import annotations

import dataclasses
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from far_app.bench.killed import KILLED, killed
from far_app.bench.report import write
from far_app.cli.options import RunOptions
from far_app.cli.stage import Stage, stage
from far_app.errors import FarError
from far_app.recording.inspect import inspect_session
from far_app.session.inbox import IntentInbox
from far_app.session.session import Session
from far_app.session.statistics import LoopStatistics, percentiles
from far_app.session_states import Intent, State
from far_app.telemetry import StopRequest
from far_app.wire import pack
from hw.fake_xarm.control import FakeXArm
from hw.fake_xarm.protocol import Function

PORT = 15502
MOVED = 0.02
"""Millimetres between two servo targets that count as motion."""
PATIENCE = 8.0
"""Seconds for a fault to be noticed, or for Resume to lead on."""


@dataclass(frozen=True, kw_only=True)
class FaultOptions:
    """Faults of a real arm on the fake controller, each many times."""

    json: Path | None = None
    """Write the table here too."""
    repeats: int = 20
    only: tuple[str, ...] = ()
    """Names of faults; all by default."""
    address: str = "127.0.0.77"
    """Loopback address for the fake controller; the next one is used too."""
    policy: str = "test:wander"


@dataclass(frozen=True, kw_only=True)
class Fault:
    strike: Callable[[Bench], object]
    heal: Callable[[FakeXArm], object] = lambda fake: None
    latches: bool = True
    """It needs the operator; else the session goes on by itself."""


@dataclass(kw_only=True)
class Bench:
    """A running session and the controller beneath it."""

    fake: FakeXArm
    stage: Stage
    session: Session
    inbox: IntentInbox
    struck: float = 0.0
    """When the last fault began."""
    box: tuple[np.ndarray, np.ndarray] = field(init=False)

    def __post_init__(self) -> None:
        safety = self.stage.rig.safety
        self.box = np.array(safety.box_min) * 1e3, np.array(safety.box_max) * 1e3

    @property
    def state(self) -> State:
        return self.session.supervision.state

    def wait(self, what: Callable[[], bool], seconds: float) -> bool:
        deadline = time.monotonic() + seconds
        while not what():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.005)
        return True

    def stop(self) -> None:
        """STOP as the page sends it: straight to the hw server."""
        import zmq

        socket = zmq.Context.instance().socket(zmq.REQ)
        socket.connect(self.stage.robot.endpoints.stop)
        socket.send(pack(StopRequest(source="bench", stamp=time.monotonic())))
        socket.poll(1000)
        socket.close(linger=0)


def _stop_while_stuck(bench: Bench) -> None:
    bench.fake.faults(latency=0.09)
    time.sleep(0.1)
    bench.struck = time.monotonic()
    bench.stop()


FAULTS: dict[str, Fault] = {
    "C31 collision": Fault(strike=lambda b: b.fake.error(31)),
    "C24 speed": Fault(strike=lambda b: b.fake.error(24)),
    "C35 boundary": Fault(strike=lambda b: b.fake.error(35)),
    "emergency stop (C1)": Fault(strike=lambda b: b.fake.tell(do="press", code=1), heal=lambda f: f.tell(do="release")),
    "emergency IO (C2)": Fault(strike=lambda b: b.fake.tell(do="press", code=2), heal=lambda f: f.tell(do="release")),
    "STOP": Fault(strike=lambda b: b.stop()),
    "STOP, servo call stuck": Fault(strike=_stop_while_stuck, heal=lambda f: f.faults(latency=0.0)),
    "FIN": Fault(strike=lambda b: b.fake.tell(do="cut")),
    "RST": Fault(strike=lambda b: b.fake.tell(do="cut", reset=True)),
    "controller restart": Fault(strike=lambda b: b.fake.tell(do="restart", seconds=1.0), heal=lambda f: time.sleep(1)),
    "silent link": Fault(strike=lambda b: b.fake.faults(mute=True), heal=lambda f: f.faults(mute=False)),
    "report stall": Fault(
        strike=lambda b: b.fake.faults(reports_stalled=True), heal=lambda f: f.faults(reports_stalled=False)
    ),
    "latency 30 ± 10 ms": Fault(
        strike=lambda b: b.fake.faults(latency=0.03, jitter=0.01), heal=lambda f: f.faults(latency=0.0, jitter=0.0)
    ),
    "190 ms stall": Fault(
        strike=lambda b: b.fake.faults(stall=0.19, stall_in=0.1), heal=lambda f: f.faults(stall=0.0), latches=False
    ),
}


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(FaultOptions, args=list(arguments), prog="far bench faults")
    known = (*FAULTS, *KILLED)
    names = options.only or known
    if unknown := [n for n in names if n not in known]:
        raise FarError(f"unknown fault {', '.join(unknown)}; choose from: {', '.join(known)}")
    report: dict[str, Any] = {"repeats": options.repeats}
    if chosen := [n for n in names if n in FAULTS]:
        report |= measure(options, chosen)
    for name in (n for n in names if n in KILLED):
        report.setdefault("faults", {})[name] = killed(name, options.repeats, options.address, options.policy)
    write(report, options.json)
    return 0


def measure(options: FaultOptions, names: list[str]) -> dict[str, Any]:
    """All faults in one session."""
    with tempfile.TemporaryDirectory(prefix="far-bench-") as recordings, running(options, Path(recordings)) as bench:
        rows = {name: row([once(bench, FAULTS[name]) for _ in range(options.repeats)]) for name in names}
        bench.inbox.put(Intent.QUIT)
        bench.wait(lambda: bench.state is State.FINISHED, 10.0)
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
    run = RunOptions(
        robot="xarm", host=f"{options.address}:{PORT}", policy=options.policy, headless=True, rerun=False,
        recordings=recordings, max_attempts=1_000_000, full_speed=True,
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
    moving = bench.wait(lambda: bench.state is State.RUNNING and bench.session._recorded > 15, 20.0)
    if not moving:
        raise FarError(f"the arm does not move: {bench.state}, {bench.session.board.reason}")
    bench.fake.received()
    bench.struck = time.monotonic()
    fault.strike(bench)
    struck = bench.struck
    noticed = not fault.latches or bench.wait(lambda: bench.state in (State.FAULT, State.STOPPED), PATIENCE)
    noticed_after = time.monotonic() - struck
    words = bench.session.board.reason
    time.sleep(0.3 if fault.latches else 1.0)
    received = bench.fake.received()
    fault.heal(bench.fake)
    path = np.array([r["pose"][:3] for r in received if r["function"] == Function.MOVE_SERVO_CART_AA])
    at = np.array([r["at"] for r in received if r["function"] == Function.MOVE_SERVO_CART_AA])
    size = np.linalg.norm(np.diff(path, axis=0), axis=1) if len(path) > 1 else np.zeros(0)
    moved = at[1:][size > MOVED]
    stops = [r["at"] for r in received if r["function"] == Function.SET_STATE and r["argument"] == 4]
    outside = int(((path < bench.box[0] - 0.1) | (path > bench.box[1] + 0.1)).any(axis=1).sum()) if len(path) else 0
    shot = {
        "noticed": noticed, "noticed_s": noticed_after, "words": words, "outside": outside,
        "hold_s": max(0.0, float(moved[-1] - struck)) if len(moved) and fault.latches else 0.0,
        "step_mm": float(size.max(initial=0.0)), "stop_s": stops[0] - struck if stops else None,
    }  # fmt: skip
    return shot | (
        resume(bench)
        if fault.latches
        else {"resumed": bench.state not in (State.FAULT, State.STOPPED), "first_mm": 0.0}
    )


def resume(bench: Bench) -> dict[str, Any]:
    """The operator looks, then presses Resume, more than once where it is refused."""
    stood = np.array(bench.fake.state()["position"])
    deadline = time.monotonic() + PATIENCE
    while bench.state in (State.FAULT, State.STOPPED) and time.monotonic() < deadline:
        bench.inbox.put(Intent.RESUME)
        bench.wait(lambda: bench.state not in (State.FAULT, State.STOPPED), 2.0)
    bench.wait(lambda: bench.state is State.RUNNING, PATIENCE)
    targets = bench.fake.servo_targets()
    path = np.array([t["pose"][:3] for t in targets]) if targets else np.empty((0, 3))
    size = np.linalg.norm(np.diff(path, axis=0), axis=1)
    first = float(np.linalg.norm(path[0] - stood)) if len(path) else float("nan")
    return {
        "resumed": bench.state is State.RUNNING, "first_mm": first, "step_after_mm": float(size.max(initial=0.0)),
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
