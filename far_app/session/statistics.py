"""How well the loop keeps time: lateness of every target, ages of plans and observations, starved ticks."""

from __future__ import annotations

import array
import time
from collections import deque
from typing import Any

import numpy as np

from far_app.session.timeline import Timeline
from far_app.telemetry import LoopHealth
from far_app.types import Ack, Step

LATE = 0.005
"""Seconds after which a tick counts as late on the page."""
OVERRUN = 0.033
"""Seconds after which a tick counts as overrun."""
SHOWN = 300
"""Ticks of the timeline on the page: ten seconds."""


class LoopStatistics:
    """Of one session (or one phase of a benchmark). Filled by the loop, read by anyone."""

    def __init__(self) -> None:
        self.late = array.array("d")
        """accepted − due of every acknowledged target, seconds."""
        self.plan_age = array.array("d")
        """Ticks between the newest chunk's observation and the tick it shaped."""
        self.observation_age = array.array("d")
        """Seconds between an observation's capture and the tick that acted on it."""
        self.homing = array.array("d")
        """Seconds from an attempt's end to the next one's start."""
        self.timeline = Timeline()
        """Where each tick's time went."""
        self.ticks = 0
        self.starved = 0
        self.overruns = 0
        """Targets accepted more than 33 ms late, refused as expired, or never acknowledged."""
        self.stale_holds = 0
        self._recent = deque[float](maxlen=60)
        self._open: dict[int, float] = {}
        """Due times of targets that wait for their acknowledgment, by sequence number."""

    def stepped(self, step: Step) -> None:
        """A tick's step is complete."""
        self.ticks += 1
        self.starved += step.starved
        if step.chunk_tick >= 0:
            self.plan_age.append(step.tick - step.chunk_tick)
        self.observation_age.append(step.deadline - step.stamp)
        self._recent.append(step.deadline)

    def sent(self, seq: int, due: float) -> None:
        """A target is on its way; one that is not answered within a second counts as an overrun."""
        self.timeline.sent(seq)
        self._open[seq] = due
        if len(self._open) > 30:
            self.overruns += self._open.pop(next(iter(self._open)), None) is not None

    def acknowledged(self, ack: Ack) -> None:
        if self._open.pop(ack.seq, None) is None:
            return
        self.timeline.acknowledged(ack)
        late = ack.accepted - ack.due
        self.late.append(late)
        self.overruns += late > OVERRUN

    def health(self) -> LoopHealth:
        """For the page; percentiles over the whole session."""
        late = np.array(self.late[:]) * 1e3 if self.late else np.zeros(1)  # a copy: the loop appends meanwhile
        now = time.monotonic()
        recent = [t for t in tuple(self._recent) if t > now - 2.0]
        span = recent[-1] - recent[0] if len(recent) > 1 else 0.0
        ages = self.plan_age[-60:]
        return LoopHealth(
            hz=(len(recent) - 1) / span if span else 0.0, ticks=self.ticks,
            late_p50_ms=float(np.percentile(late, 50)), late_p99_ms=float(np.percentile(late, 99)),
            late_max_ms=float(late.max()), late_ticks=int((late > LATE * 1e3).sum()), overruns=self.overruns,
            starved=self.starved, plan_age_ticks=float(np.median(ages)) if ages else 0.0,
            stages=self.timeline.recent(SHOWN),
        )  # fmt: skip

    def summary(self) -> dict[str, Any]:
        """The fields `far run --summary-json` and `far bench loop` share."""
        return {
            "ticks": self.ticks,
            "late_ms": percentiles(self.late, 1e3),
            "overruns": self.overruns,
            "starved": self.starved,
        }


def percentiles(values: array.array[float] | list[float], scale: float = 1.0) -> dict[str, float | None]:
    """p50, p99, p99.9 and the largest; None with no values."""
    if not len(values):
        return dict.fromkeys(("p50", "p99", "p999", "max"))
    array_ = np.asarray(values, dtype=float) * scale
    p50, p99, p999, largest = np.percentile(array_, (50, 99, 99.9, 100)).round(3).tolist()
    return {"p50": p50, "p99": p99, "p999": p999, "max": largest}
