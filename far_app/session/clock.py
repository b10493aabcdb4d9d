"""Absolute deadlines on the monotonic clock: tick i is due at t0 + i·dt."""

from __future__ import annotations

import time

LEAD = 0.001
"""Seconds before a tick's deadline at which its work begins: what it takes from there until its target is with the arm,
measured (`far bench loop`)."""


class TickClock:
    """Paces a loop. A tick less than one period late runs at once and the grid stays; after a longer stall the missed
    deadlines are dropped (never a burst to catch up), the grid is anchored anew and the stall is counted."""

    def __init__(self, rate: float, lead: float = LEAD) -> None:
        self.period = 1.0 / rate
        """Seconds."""
        self.lead = lead
        self.stalls = 0
        self._due = time.monotonic()

    def restart(self) -> None:
        """The next tick is due one period from now."""
        self._due = time.monotonic() + self.period

    def wait(self) -> float:
        """Sleep until `lead` before the next deadline and return the deadline (after a stall: the missed one)."""
        due = self._due
        now = time.monotonic()
        if now < due - self.lead:
            time.sleep(due - self.lead - now)
        if now < due + self.period:
            self._due = due + self.period
        else:
            self.stalls += 1
            self._due = now + self.period
        return due
