"""Absolute deadlines on the monotonic clock: tick i is due at t0 + i·dt."""

from __future__ import annotations

import time


class TickClock:
    """Paces a loop. A tick less than one period late runs at once and the grid stays; after a longer stall the missed
    deadlines are dropped (never a burst to catch up), the grid is anchored anew and the stall is counted."""

    def __init__(self, rate: float) -> None:
        self.period = 1.0 / rate
        """Seconds."""
        self.stalls = 0
        self._due = time.monotonic()

    def restart(self) -> None:
        """The next tick is due one period from now."""
        self._due = time.monotonic() + self.period

    def wait(self) -> float:
        """Sleep until the next deadline and return it (after a stall: the one that was missed)."""
        due = self._due
        now = time.monotonic()
        if now < due:
            time.sleep(due - now)
            self._due = due + self.period
        elif now < due + self.period:
            self._due = due + self.period
        else:
            self.stalls += 1
            self._due = now + self.period
        return due
