"""`far bench adapt`: seconds from a failed attempt to a new policy version, by stage, with the 30 Hz loop running.

Naive trials go on in the twin all along; meanwhile one failed attempt is learnt from again and again, in the background
thread a session would use: in the fast form and in the plain one, which take turns. Then adaptations are cancelled at
moments spread over their course. `homing` is what the same machine needs to take the arm home: the time there is.
`growth` (far_app/bench/adapt_growth.py) is measured without a loop.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from far_app.bench.adapt_growth import growth
from far_app.bench.loop import Unlearning, naive_session
from far_app.bench.report import write
from far_app.cli.options import RunOptions
from far_app.cli.settings import recommended
from far_app.cli.stage import stage
from far_app.errors import ConfigError, FarError
from far_app.protocols import Method
from far_app.session.adaptation import BackgroundAdaptation
from far_app.session.inbox import IntentInbox
from far_app.session.statistics import LoopStatistics, percentiles
from far_app.session_states import Intent
from far_app.types import Adaptation, Attempt


@dataclass(frozen=True, kw_only=True)
class AdaptOptions:
    """Seconds from a failed attempt to a new policy version, by stage."""

    rounds: int = 30
    """Adaptations to measure in the fast form."""
    plain_rounds: int = 5
    """And in the plain one, spread among them."""
    cancels: int = 20
    """Adaptations to cancel."""
    policy: str | None = None
    """Policy checkpoint; the shipped quickstart model by default. untrained:paper has the paper's sizes."""
    critic: Path | None = None
    """Critic checkpoint; the one beside the policy by default."""
    seed: int = 0
    torch_threads: int = 1
    attempt_seconds: float = 20.0
    """How long to run trials first, to see one fail."""
    growth: str = "quickstart"
    """Preset whose growth with the attempt's length and M is measured; "" for none."""
    json: Path | None = None
    """Write the report here."""

    def __post_init__(self) -> None:
        for name, least in (("rounds", 1), ("plain_rounds", 0), ("cancels", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"--{name.replace('_', '-')} is {getattr(self, name)}, must be at least {least}")


@dataclass
class Measured:
    """Adaptations of one form."""

    seconds: list[float] = field(default_factory=list)
    adaptations: list[Adaptation] = field(default_factory=list)

    def row(self, form: str) -> dict[str, Any]:
        last = self.adaptations[-1]
        stages = {k: float(np.median([a.seconds.get(k, 0.0) for a in self.adaptations])) for k in last.seconds}
        return {
            "form": form, "rounds": len(self.seconds), "status": sorted({a.status for a in self.adaptations}),
            "pairs": last.pairs, "seconds": percentiles(self.seconds), "stages": stages,
        }  # fmt: skip


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(AdaptOptions, args=list(arguments), prog="far bench adapt")
    write(measure(options), options.json)
    return 0


def measure(options: AdaptOptions) -> dict[str, Any]:
    """{"ticks", "forms": a row each, "speedup", "cancel_ms", "homing", "growth": rows}."""
    forms = {"fast": Measured(), "plain": Measured()}
    late: list[float] = []
    with tempfile.TemporaryDirectory(prefix="far-bench-") as recordings:
        run = RunOptions(
            seed=options.seed, policy=options.policy, critic=options.critic, method="far", headless=True, rerun=False,
            torch_threads=options.torch_threads, recordings=Path(recordings),
            retry=recommended(RunOptions.task, options.policy),
        )  # fmt: skip
        with stage(run) as stage_:
            methods = {"fast": stage_.parts.method, "plain": plainly(stage_.parts.another())}
            _, failure, _ = naive_session(stage_, options.attempt_seconds)
            inbox, statistics = IntentInbox(), LoopStatistics()
            ended = threading.Event()

            def learn() -> None:
                try:
                    for form in turns(options.rounds, options.plain_rounds):
                        once(methods[form], failure, ended, forms[form])
                    typical = float(np.median(forms["fast"].seconds))
                    for i in range(options.cancels):
                        after = typical * (i + 0.5) / options.cancels
                        late.extend(cancelled(methods["fast"], failure, ended, after))
                finally:
                    inbox.put(Intent.QUIT)

            learning = threading.Thread(target=learn, name="bench-learning", daemon=True)
            unlearning = Unlearning(stage_.parts.method)
            with stage_.session(stage_.writer(), inbox, statistics, method=unlearning) as session:
                learning.start()
                try:
                    session.run()
                finally:
                    ended.set()
                    learning.join()
    if not forms["fast"].seconds:
        raise FarError("the session ended before an adaptation was done; measure again")
    rows = [measured.row(form) for form, measured in forms.items() if measured.seconds]
    return {
        "ticks": len(failure.steps), "forms": rows,
        "speedup": rows[1]["seconds"]["p50"] / rows[0]["seconds"]["p50"] if len(rows) > 1 else None,
        "cancel_ms": percentiles(late, 1e3), "homing": percentiles(statistics.homing),
        "growth": growth(options.growth) if options.growth else [],
    }  # fmt: skip


def turns(fast: int, plain: int) -> list[str]:
    """Which form comes when: the few plain rounds evenly among the fast ones."""
    order = [(i / fast, "fast") for i in range(fast)] + [((i + 0.5) / plain, "plain") for i in range(plain)]
    return [form for _, form in sorted(order)]


def plainly(method: Method) -> Method:
    """The same method, its denoiser run as it is written."""
    from far_app.learning.trainable import plain
    from far_app.methods.retry import RetryMethod

    assert isinstance(method, RetryMethod), "the benchmark's method learns"
    method.arrange = plain
    return method


def once(method: Method, failure: Attempt, ended: threading.Event, into: Measured) -> None:
    """One adaptation from beginning to end, unless the session ends first."""
    began, adaptation = begun(method, failure)
    wait(lambda: adaptation.done() or ended.is_set())
    if ended.is_set():
        return adaptation.cancel(wait=True)
    into.seconds.append(time.monotonic() - began)
    into.adaptations.append(adaptation.result())
    return None


def cancelled(method: Method, failure: Attempt, ended: threading.Event, after: float) -> list[float]:
    """Seconds from a cancellation to the thread's end; nothing when the adaptation was over before."""
    began, adaptation = begun(method, failure)
    wait(lambda: time.monotonic() > began + after or not adaptation.running or ended.is_set())
    was_running, asked = adaptation.running, time.monotonic()
    adaptation.cancel(wait=True)
    return [time.monotonic() - asked] if was_running else []


def begun(method: Method, failure: Attempt) -> tuple[float, BackgroundAdaptation]:
    method.begin(failure.scene_seed)
    return time.monotonic(), BackgroundAdaptation(method, failure, limit=600.0)


def wait(until: Callable[[], bool]) -> None:
    while not until():
        time.sleep(0.005)
