"""`far bench loop`: does learning disturb control? The whole application for a while, half of it with FCPA running.

The twin at 30 Hz with recording, the page's process and one connected client (a raw WebSocket: a browser on the same
cores would measure the browser). Lateness is that of a target's acceptance in the hw server; `floor` is a bare sleeper
in a process of its own, all along, with a fixed piece of work at each wake-up: where that takes many times its median,
the machine itself stalled.
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
from typing import Any

import tyro

from far_app.bench.report import write
from far_app.cli.options import EngineName, RunOptions
from far_app.cli.settings import recommended
from far_app.cli.stage import Stage, stage
from far_app.errors import ConfigError, FarError
from far_app.protocols import Method
from far_app.session.adaptation import BackgroundAdaptation, unchanged
from far_app.session.inbox import IntentInbox
from far_app.session.statistics import LoopStatistics, percentiles
from far_app.session_states import Intent
from far_app.types import Attempt


@dataclass(frozen=True, kw_only=True)
class LoopOptions:
    """Lateness of the 30 Hz loop with everything running, idle and adapting."""

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
    seed: int = 0
    port: int = 0
    """The page's port; 0 takes a free one."""
    torch_threads: int = 1
    page: bool = True
    """Run the page and its client too."""

    def __post_init__(self) -> None:
        if self.seconds < 10:
            raise ConfigError(f"--seconds is {self.seconds:g}, must be at least 10 (an attempt each half)")


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(LoopOptions, args=list(arguments), prog="far bench loop")
    report = measure(options)
    write(report, options.json)
    return 0


def measure(options: LoopOptions) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="far-bench-") as recordings:
        run = RunOptions(
            seed=options.seed, policy=options.policy, critic=options.critic, port=options.port, method="far",
            engine=options.engine,
            headless=not options.page, rerun=False, torch_threads=options.torch_threads, recordings=Path(recordings),
            retry=recommended(RunOptions.task, options.policy),
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
    statistics, inbox = LoopStatistics(), IntentInbox()

    def end() -> None:
        if threads is not None:
            threads.update(processor_seconds(THREADS))
        inbox.put(Intent.QUIT)

    timer = threading.Timer(seconds, end)
    timer.daemon = True
    with stage_.session(stage_.writer(), inbox, statistics, method=Unlearning(stage_.parts.method)) as session_:
        timer.start()
        session_.run()
    if session_.recorder.error is not None:
        raise session_.recorder.error
    return statistics, session_.driver.last_failure


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
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
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
