"""`far bench loop`: does learning disturb control? The whole application for a while, half of it with FCPA running.

At 30 Hz with recording, the page's process and one connected client (a raw WebSocket: a browser on the same cores would
measure the browser). The arm is the twin, or with `--robot xarm` a real one as the program sees it: the driver and the
SDK on a fake controller, synthetic cameras, and nothing to be simulated or drawn on these cores. Lateness is that of a
target's acceptance in the hw server; `floor` is a bare sleeper in a process of its own, all along, with a fixed piece
of work at each wake-up: where that takes many times its median, the machine itself stalled.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from far_app.bench.report import write
from far_app.cli.options import EngineName, RunOptions
from far_app.cli.settings import recommended
from far_app.cli.stage import Stage, stage
from far_app.endpoints import Endpoints
from far_app.errors import ConfigError, FarError
from far_app.protocols import Method
from far_app.session.adaptation import BackgroundAdaptation, unchanged
from far_app.session.inbox import IntentInbox
from far_app.session.session import Session
from far_app.session.statistics import LoopStatistics, percentiles
from far_app.session_states import Intent, State
from far_app.types import Attempt
from hw.fake_xarm.control import FakeXArm


@dataclass(frozen=True, kw_only=True)
class LoopOptions:
    """Lateness of the 30 Hz loop with everything running, idle and adapting; and how old its plans are."""

    seconds: float = 60.0
    """How long to measure, both halves together."""
    json: Path | None = None
    """Write the report here."""
    policy: str | None = None
    """Policy checkpoint; the shipped quickstart model by default."""
    critic: Path | None = None
    """Critic checkpoint; the one beside the policy by default."""
    engine: EngineName = "auto"
    """Runs the policy, as in `far run`."""
    robot: Literal["twin", "xarm"] = "twin"
    """xarm: the real driver on a fake controller of its own, the rig hw/rigs/rehearsal.toml."""
    fake: str = "127.114.77.1:15502"
    """Where that controller listens."""
    seed: int = 0
    port: int = 0
    """The page's port; 0 takes a free one."""
    torch_threads: int = 1
    learning_apart: bool = True
    """Learn in a process of its own, as `far run` does."""
    page: bool = True
    """Run the page and its client too."""

    def __post_init__(self) -> None:
        if self.seconds < 10:
            raise ConfigError(f"--seconds is {self.seconds:g}, must be at least 10 (an attempt each half)")
        if not self.fake.partition(":")[2].isdigit():
            raise ConfigError(f"--fake is '{self.fake}', must be ADDRESS:PORT with an address of loopback")


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(LoopOptions, args=list(arguments), prog="far bench loop")
    report = measure(options)
    write(report, options.json)
    return 0


def measure(options: LoopOptions) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="far-bench-") as recordings, arm(options) as there:
        run = RunOptions(
            seed=options.seed, policy=options.policy, critic=options.critic, port=options.port, method="far",
            engine=options.engine,
            headless=not options.page, rerun=False, torch_threads=options.torch_threads,
            learning_apart=options.learning_apart, recordings=Path(recordings),
            retry=recommended(RunOptions.task, options.policy), **there,
        )  # fmt: skip
        with stage(run) as stage_, client(stage_.page_url, options.seconds) as connected:
            half = options.seconds / 2
            with floor(stage_.task.rate) as woken:
                idle_threads: dict[str, float] = {}
                adapting_threads: dict[str, float] = {}
                idle, attempt, idle_span = naive_session(stage_, half, idle_threads)
                with learning_all_along(stage_.parts.method, attempt) as rounds:
                    adapting, _, adapting_span = naive_session(stage_, half, adapting_threads)
    return {
        "seconds": options.seconds,
        "page_client": connected,
        "idle": _phase(idle, idle_threads) | {"floor": _floor(woken, idle_span)},
        "adapting": _phase(adapting, adapting_threads)
        | {"floor": _floor(woken, adapting_span), "adaptations": len(rounds)},
        "floor": _floor(woken, (0.0, float("inf"))),
    }


@contextlib.contextmanager
def arm(options: LoopOptions) -> Iterator[dict[str, Any]]:
    """What `far run` is told about the arm, which is there meanwhile. Nobody judges: every attempt fails."""
    if options.robot == "twin":
        yield {}
        return
    address, _, port = options.fake.partition(":")
    fake = FakeXArm.start(address, int(port))
    try:
        yield {
            "rig": "rehearsal", "host": options.fake, "accept_differences": True, "full_speed": True, "judge_wait": 0.0,
            "max_attempts": 1000,
        }  # fmt: skip
    finally:
        fake.close()


THREADS = ("recorder", "telemetry")
"""Those that serve the loop and share its interpreter."""


def naive_session(
    stage_: Stage, seconds: float, threads: dict[str, float] | None = None
) -> tuple[LoopStatistics, Attempt, tuple[float, float]]:
    """Trials under naive retry for so long; returns the last failed attempt too, and when it was. `threads` is filled
    with the processor seconds of each of THREADS."""
    began = time.monotonic()
    statistics, failure = naive_trials(stage_, seconds, threads)
    if failure is None:
        raise FarError(f"no attempt failed within {seconds:g} s, so there is nothing to adapt from; measure for longer")
    return statistics, failure, (began, time.monotonic())


def naive_trials(
    stage_: Stage, seconds: float, threads: dict[str, float] | None = None
) -> tuple[LoopStatistics, Attempt | None]:
    """Trials under naive retry for so long; returns the last failed attempt, if one failed."""
    statistics, inbox = LoopStatistics(), IntentInbox(Endpoints.in_folder(stage_.folder).intents)

    def end() -> None:
        if threads is not None:
            threads.update(processor_seconds(THREADS))
        inbox.put(Intent.QUIT)

    timer = threading.Timer(seconds, end)
    timer.daemon = True
    method = Unlearning(stage_.parts.method)
    with contextlib.closing(inbox), stage_.session(stage_.writer(), inbox, statistics, method=method) as session_:
        timer.start()
        with scene_ready(session_, inbox):
            session_.run()
    if session_.recorder.error is not None:
        raise session_.recorder.error
    return statistics, session_.driver.last_failure


@contextlib.contextmanager
def scene_ready(session_: Session, inbox: IntentInbox) -> Iterator[None]:
    """Whenever the session asks for the scene of a real arm, it is told that it is there."""
    ended = threading.Event()

    def answer() -> None:
        while not ended.wait(0.2):
            if session_.standing.state is State.AWAITING_SCENE:
                inbox.put(Intent.SCENE_READY)

    thread = threading.Thread(target=answer, name="bench-scene", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def processor_seconds(names: Sequence[str]) -> dict[str, float]:
    """What the running threads of those names have used of a processor since they began."""
    return {
        t.name: time.clock_gettime(time.pthread_getcpuclockid(t.ident))
        for t in threading.enumerate()
        if t.name in names and t.ident is not None
    }


class Unlearning:
    """The base policy of a method, tried again unchanged: what runs in both halves."""

    def __init__(self, method: Method) -> None:
        method.begin(0)
        self.name, self.policy = "nr", method.policy
        self.perturb = method.perturb

    def begin(self, scene_seed: int) -> None: ...

    def adapt(self, attempt: Attempt, cancelled: Any, progress: Any) -> Any:
        return unchanged(self.policy.version, "none")


@contextlib.contextmanager
def learning_all_along(method: Method, attempt: Attempt) -> Iterator[list[float]]:
    """One adaptation after the other on the same failed attempt, as a session runs them; yields their durations."""
    ended, rounds = threading.Event(), list[float]()

    def learn() -> None:
        while not ended.is_set():
            began = time.monotonic()
            method.begin(attempt.scene_seed)
            adaptation = BackgroundAdaptation(method, attempt, limit=600.0)
            while adaptation.running and not ended.wait(0.05):
                pass
            if adaptation.running:
                adaptation.cancel(wait=True)
            else:
                rounds.append(time.monotonic() - began)

    thread = threading.Thread(target=learn, name="bench-learning", daemon=True)
    thread.start()
    try:
        yield rounds
    finally:
        ended.set()
        thread.join()


Woken = tuple[float, float, float]
"""A wake-up of the sleeper: deadline, lateness, and what a fixed piece of work took then; seconds."""


@contextlib.contextmanager
def floor(rate: float) -> Iterator[list[Woken]]:
    """The sleeper, alongside; its wake-ups are there at the end."""
    woken: list[Woken] = []
    command = [sys.executable, "-m", "far_app.bench.floor", str(rate)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        yield woken
    finally:
        process.terminate()
        output, _ = process.communicate(timeout=10)
        woken += [(due, late, work) for due, late, work in json.loads(output or "[]")]


@contextlib.contextmanager
def client(page_url: str, seconds: float) -> Iterator[bool]:
    """One client on the page, reading all it is sent."""
    if not page_url:
        yield False
        return
    command = [sys.executable, "-m", "ui.raw_client", page_url, "--seconds", str(seconds + 60)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert process.stdout is not None
    process.stdout.readline()  # it looks; without somebody who does, a real arm is held
    try:
        yield True
        if process.poll() is not None:
            raise FarError("the page's client lost its connection during the measurement; measure again")
    finally:
        process.terminate()
        process.wait(10)


def _phase(statistics: LoopStatistics, threads: dict[str, float]) -> dict[str, Any]:
    """`threads_ms`: milliseconds of a processor for each tick of the loop."""
    ages = {"plan_age_ticks": (statistics.plan_age, 1.0), "obs_age_ms": (statistics.observation_age, 1e3)}
    wanted = ("p50", "p99")
    return (
        statistics.summary()
        | {"stages_ms": statistics.timeline.percentiles()}
        | {
            name: {k: v for k, v in percentiles(values, scale).items() if k in wanted}
            for name, (values, scale) in ages.items()
        }
        | {"threads_ms": {name: round(1e3 * s / max(1, statistics.timeline.ticks), 3) for name, s in threads.items()}}
    )


def _floor(woken: list[Woken], span: tuple[float, float]) -> dict[str, Any]:
    inside = [(late, work) for due, late, work in woken if span[0] <= due <= span[1]]
    late, work = [late for late, _ in inside], [work for _, work in inside]
    return {"ticks": len(inside), "late_ms": percentiles(late, 1e3), "work_ms": percentiles(work, 1e3)}
