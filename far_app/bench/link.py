"""`far bench link`: two machines joined by a slow cable that stalls and is cut. What becomes of the arm?

The app here; hw server and fake controller on the other side (far_app/bench/machines.py), with a clock ten hours ahead.
Phases: the delay alone; stalls; the cable cut, mended, resumed; STOP while the arm moves. "Largest step" is between any
two servo targets in a row as the controller received them, holds and resumptions included: a jump would show in it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from far_app.bench.machines import AHEAD, FAR, RobotPC, robot_pc, separable
from far_app.bench.report import write
from far_app.bench.servo_trace import ServoTrace, servo_trace
from far_app.bench.waiting import came_true
from far_app.cli.options import RunOptions
from far_app.cli.stage import Stage, stage
from far_app.errors import FarError
from far_app.session.inbox import IntentInbox
from far_app.session.session import Session
from far_app.session.statistics import LoopStatistics, percentiles
from far_app.session_states import Intent, State
from hw.fake_xarm.protocol import Function
from ui.stop import StopLine

PATIENCE = 15.0


@dataclass(frozen=True, kw_only=True)
class LinkOptions:
    """A robot PC and a GPU PC on this machine, a bad cable between them."""

    json: Path | None = None
    """Write the report here too."""
    delay: float = 0.005
    """Seconds that the cable adds, each way."""
    stall: float = 0.2
    every: float = 2.0
    """Seconds for which it stalls, and from one stall to the next."""
    seconds: float = 30.0
    """Of the phase without stalls, and of the one with them."""
    cuts: int = 3
    stops: int = 10
    loopback: bool = False
    """No network namespaces; taken anyway where they are not permitted."""


def main(arguments: Sequence[str]) -> int:
    inside = "--inside" in arguments
    options = tyro.cli(LinkOptions, args=[a for a in arguments if a != "--inside"], prog="far bench link")
    if not inside and not options.loopback and (apart := separable()):
        sys.stdout.flush()
        os.execvp(apart[0], [*apart, sys.executable, "-c", FAR, "bench", "link", *arguments, "--inside"])
    with (
        tempfile.TemporaryDirectory(prefix="far-link-") as folder,
        robot_pc(Path(folder), inside, options.delay) as other,
    ):
        report = measure(options, other, Path(folder) / "recordings")
    write(report, options.json)
    return 0


@dataclass(kw_only=True)
class Run:
    """A session under way over the cable."""

    other: RobotPC
    stage: Stage
    session: Session
    inbox: IntentInbox
    statistics: LoopStatistics

    @property
    def state(self) -> State:
        return self.session.standing.state

    @property
    def holds(self) -> int:
        newest = self.session.robot.newest
        return newest.status.holds if newest is not None else 0

    def trace(self) -> ServoTrace:
        """Of what the controller received since last asked."""
        return servo_trace(self.other.fake.servo_targets(), self.stage.rig.safety)

    def moving(self) -> None:
        """Until the arm is led by the policy, resumed if need be. Raises FarError where it does not come to that."""
        deadline = time.monotonic() + 2 * PATIENCE
        while not (self.state is State.RUNNING and self.session.driver.recorded > 15):
            if time.monotonic() > deadline:
                raise FarError(f"the arm does not move: {self.state}, {self.session.board.reason}")
            if self.state in (State.FAULT, State.STOPPED):
                self.inbox.put(Intent.RESUME)
                came_true(lambda: self.state not in (State.FAULT, State.STOPPED), 2.0)
            time.sleep(0.01)


@contextlib.contextmanager
def running(other: RobotPC, recordings: Path) -> Iterator[Run]:
    run = RunOptions(
        robot="xarm", hw=other.address, keys=other.keys, policy="test:wander", headless=True, rerun=False,
        judge_wait=0.0, recordings=recordings, max_attempts=1_000_000, full_speed=True,
    )  # fmt: skip
    with stage(run) as made:
        attended = dataclasses.replace(made, options=dataclasses.replace(run, headless=False))
        inbox, statistics = IntentInbox(), LoopStatistics()
        with attended.session(attended.writer(), inbox, statistics) as session:
            thread = threading.Thread(target=session.run, name="session", daemon=True)
            thread.start()
            yield Run(other=other, stage=attended, session=session, inbox=inbox, statistics=statistics)
            inbox.put(Intent.QUIT)
            thread.join(10.0)


def measure(options: LinkOptions, other: RobotPC, recordings: Path) -> dict[str, Any]:
    with running(other, recordings) as run:
        clock = run.stage.robot.clock
        report: dict[str, Any] = {"apart": other.apart, "delay_ms": 1e3 * options.delay}
        report["steady"] = steady(run, options.seconds)
        report["stalls"] = stalls(run, options)
        report["cuts"] = [cut(run) for _ in range(options.cuts)]
        report["stop"] = stops(run, options.stops)
        report["clock"] = {
            "error_ms": round(1e3 * (clock.offset - AHEAD), 3), "bound_ms": round(1e3 * clock.bound(), 3),
            "round_trip_ms": round(1e3 * clock.round_trip, 3), "exchanges": clock.exchanges,
        }  # fmt: skip
        return report


def steady(run: Run, seconds: float) -> dict[str, Any]:
    """Nothing but the delay."""
    run.moving()
    run.other.fake.received()
    holds, late = run.holds, len(run.statistics.late)
    ages = len(run.statistics.observation_age)
    time.sleep(seconds)
    statistics = run.statistics
    return {
        "seconds": seconds, "holds": run.holds - holds, "late_ms": percentiles(statistics.late[late:], 1e3),
        "observation_age_ms": percentiles(statistics.observation_age[ages:], 1e3),
        "largest_step_mm": run.trace().largest_step,
    }  # fmt: skip


def stalls(run: Run, options: LinkOptions) -> dict[str, Any]:
    """The cable stalls again and again while the policy leads the arm."""
    run.moving()
    run.other.fake.received()
    holds, first, stale = run.holds, len(run.other.stalls), run.statistics.stale_holds
    run.other.tell(f"stall {options.stall} {options.every}")
    time.sleep(options.seconds)
    run.other.tell("stall 0 1")
    time.sleep(1.0)
    seen = run.trace()
    return {
        "stalls": len(run.other.stalls) - first, "stall_ms": 1e3 * options.stall, "holds": run.holds - holds,
        "observations_stale": run.statistics.stale_holds - stale, "largest_step_mm": seen.largest_step,
        "still_on_the_wire": seen.stills, "largest_first_step_after_mm": seen.step_after_still,
        "outside_box": seen.outside, "ended_in": run.state.value,
    }  # fmt: skip


def cut(run: Run) -> dict[str, Any]:
    """The cable is pulled out; plugged in again; the operator resumes."""
    run.moving()
    run.other.fake.received()
    pulled = time.monotonic()
    run.other.tell("cut")
    told = came_true(lambda: run.state is State.FAULT, PATIENCE)
    told_after, words = time.monotonic() - pulled, run.session.board.reason
    time.sleep(1.0)
    before = run.trace()
    stood = np.array(run.other.fake.state()["position"])
    run.other.tell("mend")
    time.sleep(2.0)
    alone = run.trace()
    run.moving()
    after = run.trace()
    return {
        "hold_ms": round(1e3 * max(0.0, before.last_motion - pulled), 1), "noticed": told,
        "noticed_ms": round(1e3 * told_after, 1), "operator_read": words,
        "moved_before_resume_mm": round(alone.way, 3),
        "first_target_after_mm": round(float(np.linalg.norm(after.first - stood)), 3),
        "largest_step_mm": max(before.largest_step, after.largest_step),
    }  # fmt: skip


def stops(run: Run, times: int) -> dict[str, Any]:
    """STOP as the page sends it, past the app, over the cable."""
    line = StopLine(run.stage.robot.endpoints)
    frames, answers = [], []
    for _ in range(times):
        run.moving()
        run.other.fake.received()
        pressed = time.monotonic()
        line.press("bench")
        came_true(lambda: run.state is State.STOPPED, PATIENCE)
        time.sleep(0.1)
        heard = [
            r["at"] for r in run.other.fake.received()
            if r["function"] == Function.SET_STATE and r["argument"] == 4
        ]  # fmt: skip
        frames += [heard[0] - pressed] if heard else []
        answers += [line.result.latency_ms / 1e3] if line.result is not None and line.result.latched else []
    line.close()
    return {
        "pressed": times, "frames": len(frames), "frame_ms": percentiles(frames, 1e3),
        "answer_ms": percentiles(answers, 1e3),
    }  # fmt: skip
