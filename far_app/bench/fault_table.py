"""What can go wrong with a real arm while a session leads it, for `far bench faults`: how it strikes, how it heals."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from far_app.bench.waiting import came_true
from far_app.cli.stage import Stage
from far_app.scheduling import MESSAGE_PRIORITY
from far_app.session.inbox import IntentInbox
from far_app.session.session import Session
from far_app.session_states import State
from hw.fake_xarm.control import FakeXArm
from ui.stop import StopLine


@dataclass(frozen=True, kw_only=True)
class Fault:
    strike: Callable[[Bench], object]
    heal: Callable[[FakeXArm], object] = lambda fake: None
    latches: bool = True
    """It needs the operator; else the session goes on by itself."""
    seconds: float = 1.0
    """For which a fault that does not latch is watched."""


@dataclass(kw_only=True)
class Bench:
    """A running session and the controller beneath it."""

    fake: FakeXArm
    stage: Stage
    session: Session
    inbox: IntentInbox
    struck: float = 0.0
    """When the last fault began."""
    load: list[subprocess.Popen[bytes]] = field(default_factory=list)
    """Busy programs beside it."""

    @property
    def state(self) -> State:
        return self.session.standing.state

    def stop(self) -> None:
        """STOP as the page sends it: straight to the hw server."""
        line = StopLine(self.stage.robot.endpoints)
        line.press("bench")
        came_true(lambda: line.result is not None and bool(line.result.latched), 1.0)
        line.close()

    def starve(self) -> None:
        """Twice as many busy programs as cores, at the usual priority."""
        busy = [sys.executable, "-c", "while True: pass"]
        self.load = [subprocess.Popen(busy) for _ in range(2 * (os.cpu_count() or 1))]

    def relieve(self) -> None:
        for program in self.load:
            program.kill()
            program.wait()


def hasten(fake: FakeXArm) -> None:
    """The fake controller stands for another machine: this one's load is not to slow it. As far as permitted."""
    assert fake.pid is not None, "the bench's own"
    for thread in Path(f"/proc/{fake.pid}/task").iterdir():
        with contextlib.suppress(OSError):
            os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(MESSAGE_PRIORITY))


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
    "CPU starved": Fault(strike=lambda b: b.starve(), latches=False, seconds=3.0),
}
