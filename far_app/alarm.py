"""An early failure alarm: an attempt that gets nowhere may end before its horizon. Off unless asked for.

    unrest_t      mean over the last W ticks of the spread of the overlapping chunks' actions for one tick
    stagnation_t  ticks since V was highest in this attempt

An attempt is ended when either score passes its limit. A limit is the split-conformal quantile of the scores' maxima
over attempts that succeeded: of new successes at most `false_alarm` are lost, half of that by either score. Pure;
asked by far_app/attempt.py.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from far_app.aggregation import Plan
from far_app.config import from_table
from far_app.errors import CheckpointError, ConfigError
from far_app.types import Judge, Outcome

WINDOW = 10
"""W, ticks."""


class Alarm(Protocol):
    """Asked once a tick, before the tick's chunk is there."""

    def begin(self) -> None: ...

    def judge(self, plan: Plan, tick: int) -> Outcome | None:
        """A failure, or None to go on."""
        ...


class NoAlarm:
    """Lets every attempt run to its horizon."""

    def begin(self) -> None: ...

    def judge(self, plan: Plan, tick: int) -> Outcome | None:
        return None


@dataclass
class Scores:
    """Of one attempt so far."""

    unrest: float = 0.0
    """Action units."""
    stagnation: int = 0
    """Ticks."""
    _spreads: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))
    _best: float = -math.inf
    _best_tick: int = 0

    def look(self, plan: Plan, tick: int) -> None:
        """Take in what is planned for this tick, and the newest V."""
        if math.isfinite(spread := plan.spread(tick)):
            self._spreads.append(spread)
        if len(self._spreads) == WINDOW:
            self.unrest = float(np.mean(self._spreads))
        if math.isfinite(value := plan.value(plan.newest_tick)) and value > self._best:
            self._best, self._best_tick = value, plan.newest_tick
        self.stagnation = tick - self._best_tick


@dataclass(frozen=True, kw_only=True)
class AlarmLimits:
    """What `far train alarm` writes."""

    unrest: float
    """Action units."""
    stagnation: float
    """Ticks."""
    false_alarm: float
    """Share of successes that may be lost, as asked for."""
    successes: int
    """How many the limits were set on."""
    policy: str = ""
    """Fingerprint of the policy."""

    def write(self, path: Path) -> None:
        path.write_text(json.dumps(asdict(self), indent=1) + "\n")


def read_limits(path: Path, policy: str) -> AlarmLimits:
    """Raises ConfigError for a file that is none, CheckpointError for another policy's."""
    try:
        limits = from_table(AlarmLimits, json.loads(path.read_text()), path.name)
    except (OSError, json.JSONDecodeError) as error:
        raise ConfigError(f"no alarm in {path} ({error}); make one with `far train alarm`") from error
    if limits.policy != policy:
        raise CheckpointError(f"{path} was made for another policy; make one for this with `far train alarm`")
    return limits


def conformal_limit(maxima: Sequence[float], alpha: float) -> float:
    """The ⌈(n + 1)(1 − α)⌉-th smallest of n: a new one exceeds it with probability at most α. Raises ConfigError where
    n is too small for that."""
    rank = math.ceil((len(maxima) + 1) * (1 - alpha))
    if rank > len(maxima):
        raise ConfigError(
            f"{len(maxima)} successes cannot tell a limit that {100 * alpha:g} % exceed; at least "
            f"{math.ceil(1 / alpha) - 1} are needed: try more scenes, or a larger --false-alarm"
        )
    return float(sorted(maxima)[rank - 1])


def calibrated(successes: Sequence[Sequence[tuple[float, int]]], false_alarm: float, policy: str = "") -> AlarmLimits:
    """Limits from the (unrest, stagnation) scores of every tick of attempts that succeeded."""
    unrest, stagnation = ([max(tick[i] for tick in ticks) for ticks in successes] for i in (0, 1))
    return AlarmLimits(
        unrest=conformal_limit(unrest, false_alarm / 2), stagnation=conformal_limit(stagnation, false_alarm / 2),
        false_alarm=false_alarm, successes=len(successes), policy=policy,
    )  # fmt: skip


class FailureAlarm:
    """Alarm: ends an attempt whose scores passed their limits."""

    def __init__(self, limits: AlarmLimits) -> None:
        self.limits = limits
        self._scores = Scores()

    def begin(self) -> None:
        self._scores = Scores()

    def judge(self, plan: Plan, tick: int) -> Outcome | None:
        self._scores.look(plan, tick)
        reason = passed(self._scores.unrest, self._scores.stagnation, self.limits)
        return Outcome(success=False, judged_by=Judge.DETECTOR, note=f"failure alarm: {reason}") if reason else None


def passed(unrest: float, stagnation: int, limits: AlarmLimits) -> str:
    """Which limit is passed, in words; empty when none is."""
    if stagnation > limits.stagnation:
        return f"the value has not risen for {stagnation} ticks (limit {limits.stagnation:g})"
    if unrest > limits.unrest:
        return f"overlapping chunks disagree by {unrest:.3f} (limit {limits.unrest:.3f})"
    return ""


class Listening:
    """Alarm that ends nothing and keeps the scores of every tick, attempt by attempt."""

    def __init__(self) -> None:
        self.attempts: list[list[tuple[float, int]]] = []
        self._scores = Scores()

    def begin(self) -> None:
        self._scores = Scores()
        self.attempts.append([])

    def judge(self, plan: Plan, tick: int) -> Outcome | None:
        self._scores.look(plan, tick)
        self.attempts[-1].append((self._scores.unrest, self._scores.stagnation))
        return None
