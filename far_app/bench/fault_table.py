"""What can go wrong with a real arm while a session leads it, for `far bench faults`: how it strikes, how it heals."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from far_app.bench.presser import Press, Presser
from far_app.cli.stage import Stage
from far_app.session.inbox import IntentInbox
from far_app.session.session import Session
from far_app.session_states import State
from hw.fake_xarm.control import FakeXArm


@dataclass(frozen=True, kw_only=True)
class Fault:
    strike: Callable[[Bench], object]
    heal: Callable[[Bench], object] = lambda bench: None
    latches: bool = True
    """It needs the operator; else the session goes on by itself."""
    seconds: float = 1.0
    """For which a fault that does not latch is watched."""
    camera: bool = False
    """It strikes the rig's camera; other faults are measured on a rig without one."""


@dataclass(kw_only=True)
class Bench:
    """A running session and the controller beneath it."""

    fake: FakeXArm
    stage: Stage
    session: Session
    inbox: IntentInbox
    presser: Presser
    camera: Path
    """File that tells the rig's synthetic camera what trouble to make."""
    struck: float = 0.0
    """When the last fault began."""
    press: Press | None = None
    """The last press of STOP, when the last fault was one."""
    load: list[subprocess.Popen[bytes]] = field(default_factory=list)
    """Busy programs beside it."""

    @property
    def state(self) -> State:
        return self.session.standing.state

    @property
    def recorded(self) -> int:
        """Ticks of the running attempt that were handed to the recorder."""
        return self.session.driver.recorded

    def stop(self) -> None:
        """STOP as the page sends it: straight to the hw server."""
        self.press = self.presser.press()
        self.struck = self.press.pressed

    def trouble(self, kind: str) -> None:
        """Of the camera; none when empty."""
        self.camera.write_text(kind)

    def starve(self) -> None:
        """Twice as many busy programs as cores, at the usual priority."""
        busy = [sys.executable, "-c", "while True: pass"]
        self.load = [subprocess.Popen(busy) for _ in range(2 * (os.cpu_count() or 1))]

    def relieve(self) -> None:
        for program in self.load:
            program.kill()
            program.wait()
        self.load = []


def _stop_while_stuck(bench: Bench) -> None:
    bench.fake.faults(latency=0.09)
    time.sleep(0.1)
    bench.stop()


def _emergency(code: int) -> Fault:
    return Fault(
        strike=lambda b: b.fake.tell(do="press", code=code), heal=lambda b: b.fake.tell(do="release")
    )  # fmt: skip


def _camera(kind: str) -> Fault:
    return Fault(strike=lambda b: b.trouble(kind), heal=lambda b: b.trouble(""), camera=True)


FAULTS: dict[str, Fault] = {
    "C31 collision": Fault(strike=lambda b: b.fake.error(31)),
    "C24 speed": Fault(strike=lambda b: b.fake.error(24)),
    "C35 boundary": Fault(strike=lambda b: b.fake.error(35)),
    "emergency stop (C1)": _emergency(1),
    "emergency IO (C2)": _emergency(2),
    "emergency IO (C3)": _emergency(3),
    "STOP": Fault(strike=lambda b: b.stop()),
    "STOP, servo call stuck": Fault(strike=_stop_while_stuck, heal=lambda b: b.fake.faults(latency=0.0)),
    "FIN": Fault(strike=lambda b: b.fake.tell(do="cut")),
    "RST": Fault(strike=lambda b: b.fake.tell(do="cut", reset=True)),
    "controller restart": Fault(strike=lambda b: b.fake.tell(do="restart", seconds=1.0), heal=lambda b: time.sleep(1)),
    "silent link": Fault(strike=lambda b: b.fake.faults(mute=True), heal=lambda b: b.fake.faults(mute=False)),
    "report stall": Fault(
        strike=lambda b: b.fake.faults(reports_stalled=True), heal=lambda b: b.fake.faults(reports_stalled=False)
    ),
    "latency 30 ± 10 ms": Fault(
        strike=lambda b: b.fake.faults(latency=0.03, jitter=0.01),
        heal=lambda b: b.fake.faults(latency=0.0, jitter=0.0),
    ),
    "190 ms stall": Fault(
        strike=lambda b: b.fake.faults(stall=0.19, stall_in=0.1), heal=lambda b: b.fake.faults(stall=0.0), latches=False
    ),
    "CPU starved": Fault(strike=lambda b: b.starve(), heal=lambda b: b.relieve(), latches=False, seconds=3.0),
    "camera unplugged": _camera("unplugged"),
    "camera frozen": _camera("frozen"),
    "camera slow": _camera("slow"),
}
