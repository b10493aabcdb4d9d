"""Absolute deadlines on the monotonic clock: tick i is due at t0 + i·dt."""

from __future__ import annotations

import math
import time

from far_app.protocols import Distant

LEAST, MOST = 0.001, 0.008
"""Seconds before a tick's deadline at which its work begins: what it takes as a rule until its target is with the arm
(`far bench loop`), and the most that the observation may age for the sake of punctuality."""
ON_THE_WAY = 0.0005
"""Seconds from a target's sending to its arrival on the same machine."""
KEPT = 0.9995
"""Share of the lead beyond LEAST that is left after another tick: half of it after 46 s at 30 Hz."""


class TickClock:
    """Paces a loop. A tick less than one period late runs at once and the grid stays; after a longer stall the missed
    deadlines are dropped (never a burst to catch up), the grid is anchored anew and the stall is counted.

    A tick's work begins as long before its deadline as the slowest one lately took, so that on a machine that now and
    then lets the loop wait its targets are there in time all the same; the hw server keeps what comes early until its
    moment. On top of that comes what a target is longer on its way to another machine."""

    def __init__(self, rate: float, robot: Distant | None = None) -> None:
        """`robot`: who gets the targets, if that may be on another machine."""
        self.period = 1.0 / rate
        """Seconds."""
        self.stalls = 0
        self._robot, self._work, self._away = robot, LEAST, 0.0
        self._due = time.monotonic()
        self._begun = math.nan

    @property
    def lead(self) -> float:
        """Seconds before a deadline at which the tick's work begins."""
        return self._work + self._away

    def restart(self) -> None:
        """The next tick is due one period from now."""
        self._due = time.monotonic() + self.period
        self._begun = math.nan

    def wait(self) -> float:
        """Sleep until `lead` before the next deadline and return the deadline (after a stall: the missed one)."""
        due = self._due
        self._begun = due - self.lead
        now = time.monotonic()
        if now < self._begun:
            time.sleep(self._begun - now)
        if now < due + self.period:
            self._due = due + self.period
        else:
            self.stalls += 1
            self._due = now + self.period
        return due

    def sent(self) -> None:
        """The tick's target is on its way: how long it took, from the moment its work should have begun, decides when
        the next one's does."""
        took = time.monotonic() - self._begun + ON_THE_WAY
        if not math.isnan(took):  # a tick was waited for
            self._work = min(MOST, max(took, LEAST + (self._work - LEAST) * KEPT))
            if self._robot is not None:
                self._away = min(self.period / 2, max(0.0, self._robot.on_the_way - ON_THE_WAY))
