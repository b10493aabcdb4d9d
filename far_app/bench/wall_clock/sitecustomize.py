"""A wall clock that can be stepped, for `far bench faults`: Python loads this file at the start of every process that
has its folder on PYTHONPATH. The file that FAR_BENCH_CLOCK names holds the seconds by which the clock is off.

Stepping the system's own clock needs privileges and would reach every program on the machine; this reaches one run.
"""

import os
import time
from collections.abc import Callable

_OFF_BY = os.environ.get("FAR_BENCH_CLOCK", "")


def _off_by() -> float:
    try:
        with open(_OFF_BY) as file:
            return float(file.read() or 0.0)
    except (OSError, ValueError):
        return 0.0


def _stepped(time_: Callable[[], float], time_ns: Callable[[], int], gettime: Callable[[int], float]) -> None:
    def clock_gettime(clock: int) -> float:
        return gettime(clock) + (_off_by() if clock == time.CLOCK_REALTIME else 0.0)

    time.time = lambda: time_() + _off_by()
    time.time_ns = lambda: time_ns() + round(1e9 * _off_by())
    time.clock_gettime = clock_gettime


if _OFF_BY:
    _stepped(time.time, time.time_ns, time.clock_gettime)
