"""Where every tick's time goes: one look at the clock at each border between two stages, into arrays made beforehand.

    observe ─► aggregate ─► send ─► aggregate ─► record ─► publish ─► sleep until the next deadline    the loop's thread
    infer      a chunk, in the planner's thread beside the loop: the tick during which it became ready
    filter     the safety filter, in the hw server: told with the target's acknowledgment, a tick or two later

Filled by the loop's thread alone; `recent` and `percentiles` may be asked by any other. Nothing is allocated in a tick.
"""

from __future__ import annotations

import array
import time
from collections import deque
from typing import Any

import numpy as np
from jaxtyping import Float

from far_app.types import TICK_STAGES, Ack, TickTimes

OBSERVE, INFER, AGGREGATE, FILTER, SEND, RECORD, PUBLISH = range(len(TICK_STAGES))
CAPACITY = 65_536
"""Ticks kept: 36 minutes at 30 Hz; then the oldest are overwritten."""
SETTLED = 4
"""Ticks after which a tick's times are complete (its acknowledgment took a way through two processes)."""
_UNANSWERED = 30
"""Targets that may wait for their acknowledgment."""


class Timeline:
    """Of one session (or one phase of a benchmark)."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        self.capacity = capacity
        self._stages = len(TICK_STAGES)
        self._ns = array.array("q", bytes(8 * capacity * self._stages))
        self._tick = array.array("q", bytes(8 * capacity))
        self._stamp = array.array("d", bytes(8 * capacity))
        self._row = -1
        """Of the tick under way; counts on past the capacity."""
        self._at = 0
        """Where its first stage lies in `_ns`."""
        self._last = 0
        """The last look at the clock, nanoseconds."""
        self._handed_out = 0
        """Rows below were handed out by `settled`."""
        self._sent: deque[tuple[int, int]] = deque(maxlen=_UNANSWERED)
        """Sequence number and row of the newest targets."""

    @property
    def ticks(self) -> int:
        """Of the loop, begun so far."""
        return self._row + 1

    def begin(self, tick: int, deadline: float) -> None:
        """The work of a tick begins. `tick`: the policy's, −1 outside attempts; `deadline`: monotonic seconds."""
        self._row += 1
        place = self._row % self.capacity
        self._tick[place], self._stamp[place] = tick, deadline
        self._at = place * self._stages
        self.restart()

    def restart(self) -> None:
        """The tick begins anew: what went before was a hold, not work."""
        for i in range(self._at, self._at + self._stages):
            self._ns[i] = 0
        self._last = time.perf_counter_ns()

    def lap(self, stage: int) -> None:
        """What passed since the last look at the clock was this stage's."""
        if self._row >= 0:
            now = time.perf_counter_ns()
            self._ns[self._at + stage] += now - self._last
            self._last = now

    def within(self, stage: int, began: int) -> None:
        """What passed since `began` (perf_counter_ns) was this stage's, and not that of the stage around it."""
        if self._row >= 0:
            spent = time.perf_counter_ns() - began
            self._ns[self._at + stage] += spent
            self._last += spent

    def elsewhere(self, stage: int, ns: int) -> None:
        """So much was spent on this stage by another thread and became known in this tick."""
        if self._row >= 0:
            self._ns[self._at + stage] += ns

    def sent(self, seq: int) -> None:
        """This tick's target."""
        self._sent.append((seq, self._row))

    def acknowledged(self, ack: Ack) -> None:
        """A target's way through the safety filter is known."""
        if ack.filter_seconds == ack.filter_seconds:  # not NaN
            row = next((row for seq, row in self._sent if seq == ack.seq), -1)
            if 0 <= row > self._row - self.capacity:
                self._ns[row % self.capacity * self._stages + FILTER] = round(ack.filter_seconds * 1e9)

    def settled(self, *, all_of_them: bool = False) -> list[TickTimes]:
        """The attempts' ticks that are complete and were not handed out yet; at an attempt's end, all of them."""
        end = self._row + 1 if all_of_them else self._row + 1 - SETTLED
        rows = range(max(self._handed_out, self._row + 1 - self.capacity), end)
        self._handed_out = max(self._handed_out, end)
        return [self._times(row % self.capacity) for row in rows if self._tick[row % self.capacity] >= 0]

    def recent(self, count: int) -> Float[np.ndarray, "T S"]:
        """Milliseconds by stage of the newest finished ticks, oldest first; float32."""
        end = self._row  # the one under way is left out
        rows = np.arange(max(0, end - min(count, self.capacity - 1)), max(0, end)) % self.capacity
        return (self._table()[rows] * 1e-6).astype(np.float32)

    def percentiles(self) -> dict[str, dict[str, float | None]]:
        """Milliseconds a tick of the attempts, by stage: p50, p99 and mean; of `infer` and `filter` over the ticks that
        have one. None where there is none."""
        rows = np.arange(max(0, self._row - self.capacity + 1), max(0, self._row)) % self.capacity
        rows = rows[np.frombuffer(self._tick, np.int64)[rows] >= 0]
        spent = self._table()[rows] * 1e-6
        return {stage: _summary(spent[:, i], i in (INFER, FILTER)) for i, stage in enumerate(TICK_STAGES)}

    def _table(self) -> np.ndarray:
        return np.frombuffer(self._ns, np.int64).reshape(self.capacity, self._stages)

    def _times(self, place: int) -> TickTimes:
        at = place * self._stages
        spent: Any = dict(zip(TICK_STAGES, (ns / 1e9 for ns in self._ns[at : at + self._stages]), strict=True))
        return TickTimes(tick=self._tick[place], stamp=self._stamp[place], **spent)


def _summary(ms: Float[np.ndarray, "T"], where_any: bool) -> dict[str, float | None]:
    ms = ms[ms > 0] if where_any else ms
    if not len(ms):
        return dict.fromkeys(("p50", "p99", "mean"))
    p50, p99 = np.percentile(ms, (50, 99))
    return {"p50": round(float(p50), 4), "p99": round(float(p99), 4), "mean": round(float(ms.mean()), 4)}
