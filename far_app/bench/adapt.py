"""`far bench adapt`: seconds from a failed attempt to a new policy version, by stage, with the 30 Hz loop running.

First naive trials, until one has failed. Then a session in the twin as any other, whose short attempts all fail: while
the arm goes home (and waits there) that one failure is learnt from again and again, in the session's background thread,
in the fast form and in the plain one, which take turns; each time with no more of its states encoded already than the
policy had when the attempt ended. Then adaptations are cancelled at moments spread over their course. `homing` is what
the naive trials needed to take the arm home: the time there is. `growth` (far_app/bench/adapt_growth.py) is measured
without a loop.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from far_app.bench.adapt_growth import growth
from far_app.bench.loop import naive_session
from far_app.bench.report import write
from far_app.cli.options import RunOptions
from far_app.cli.settings import recommended
from far_app.cli.stage import stage
from far_app.errors import ConfigError, FarError
from far_app.learning.cancellation import Cancelled
from far_app.protocols import Method, Policy, Progress
from far_app.scheduling import learning_threads
from far_app.session.adaptation import unchanged
from far_app.session.inbox import IntentInbox
from far_app.session.statistics import LoopStatistics, percentiles
from far_app.session_states import Intent
from far_app.types import Adaptation, Attempt

if TYPE_CHECKING:
    from far_app.methods.retry import RetryMethod

ATTEMPTS, SHORT = 5, 20
"""Of a trial whose attempts all fail, and the ticks of one: the failure that is learnt from has its own."""
PATIENCE = 600.0
"""Seconds after which a session would go on without an adaptation."""


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
    learning_threads: int = field(default_factory=learning_threads)
    learning_apart: bool = True
    """In a process of its own, as `far run` does; the plain form is made in the loop's."""
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
    with tempfile.TemporaryDirectory(prefix="far-bench-") as recordings:
        run = RunOptions(
            seed=options.seed, policy=options.policy, critic=options.critic, method="far", headless=True, rerun=False,
            torch_threads=options.torch_threads, learning_threads=options.learning_threads,
            learning_apart=options.learning_apart, recordings=Path(recordings), max_attempts=ATTEMPTS, trials=1000,
            retry=replace(recommended(RunOptions.task, options.policy), adaptation_limit=PATIENCE),
        )  # fmt: skip
        with stage(run) as stage_:
            statistics, failure, _ = naive_session(stage_, options.attempt_seconds)
            inbox = IntentInbox()
            forms = {"fast": learning(stage_.parts.method), "plain": plainly(learning(stage_.parts.another()))}
            taught = Taught(forms, failure, options, ended=lambda: inbox.put(Intent.QUIT))
            doomed = replace(stage_, task=replace(stage_.task, judge="person", horizon=SHORT))
            with doomed.session(doomed.writer(), inbox, LoopStatistics(), method=taught) as session:
                session.run()
    rows = [measured.row(form) for form, measured in taught.measured.items() if measured.seconds]
    if not rows:
        raise FarError("the session ended before an adaptation was done; measure again")
    return {
        "ticks": len(failure.steps), "forms": rows,
        "speedup": rows[1]["seconds"]["p50"] / rows[0]["seconds"]["p50"] if len(rows) > 1 else None,
        "cancel_ms": percentiles(taught.late, 1e3), "homing": percentiles(statistics.homing),
        "growth": growth(options.growth) if options.growth else [],
    }  # fmt: skip


class Taught:
    """A method that learns from one failure again and again, whatever failed: in the fast form, in the plain one, or
    until it is cancelled. Its trials never leave the base policy behind for long."""

    name = "far"

    def __init__(
        self, forms: Mapping[str, RetryMethod], failure: Attempt, options: AdaptOptions, ended: Callable[[], None]
    ) -> None:
        self.forms, self.failure, self.ended = forms, failure, ended
        self.turns = iter([*turns(options.rounds, options.plain_rounds), *["cancelled"] * options.cancels])
        self.cancels = options.cancels
        self.measured = {form: Measured() for form in forms}
        self.late: list[float] = []
        """Seconds from each cancellation until it was heeded."""
        self.perturb = forms["fast"].perturb
        self._seen = forms["fast"].memory.copy()
        self._cancelled = 0

    @property
    def policy(self) -> Policy:
        return self.forms["fast"].policy

    def begin(self, scene_seed: int) -> None:
        self.forms["fast"].begin(scene_seed)

    def adapt(self, attempt: Attempt, cancelled: Cancelled, progress: Progress) -> Adaptation:
        turn = next(self.turns, "")
        if not turn:
            self.ended()
            return unchanged(self.policy.version, "none")
        method = self.forms["plain" if turn == "plain" else "fast"]
        method.begin(attempt.scene_seed)
        method.memory = self._seen.copy()
        began = time.monotonic()
        if turn == "cancelled":
            typical = float(np.median(self.measured["fast"].seconds))
            moment = began + typical * (self._cancelled + 0.5) / self.cancels
            self._cancelled += 1
            adaptation = method.adapt(self.failure, lambda: cancelled() or time.monotonic() > moment, progress)
            if adaptation.status == "cancelled":
                self.late.append(time.monotonic() - moment)
            return adaptation
        adaptation = method.adapt(self.failure, cancelled, progress)
        if adaptation.status != "cancelled":
            self.measured[turn].seconds.append(time.monotonic() - began)
            self.measured[turn].adaptations.append(adaptation)
        return adaptation


def turns(fast: int, plain: int) -> list[str]:
    """Which form comes when: the few plain rounds evenly among the fast ones."""
    order = [(i / fast, "fast") for i in range(fast)] + [((i + 0.5) / plain, "plain") for i in range(plain)]
    return [form for _, form in sorted(order)]


def learning(method: Method) -> RetryMethod:
    """The benchmark's method, which learns."""
    from far_app.methods.retry import RetryMethod

    assert isinstance(method, RetryMethod), "far is one"
    return method


def plainly(method: RetryMethod) -> RetryMethod:
    """The same method, its networks run as they are written, on one thread."""
    from far_app.learning.apart.here import WorkHere
    from far_app.learning.trainable import plain

    method.work, method.encode = WorkHere(arrange=plain), method.base.encode
    return method
