"""The floor: how late a bare 30 Hz sleeper wakes on this machine, under the same load and priority as the loop, and how
long the same small piece of work takes it each time.

`python -m far_app.bench.floor` sleeps until SIGTERM (or its parent's death) and prints [[deadline, late, work], …] as
JSON, seconds. Runs nothing else, so that nothing but the machine is measured: a machine that stalls whole processes (a
virtual one, whose host is busy) wakes a sleeper in time all the same, but is slow at its work.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time

from far_app.scheduling import LOOP_PRIORITY, real_time

WORK = 20_000
"""Additions of a piece of work: some tenths of a millisecond."""


def work() -> int:
    return sum(range(WORK))


def main() -> None:
    rate = float(sys.argv[1])
    ended: list[int] = []
    signal.signal(signal.SIGTERM, lambda *_: ended.append(1))
    parent = os.getppid()
    real_time(LOOP_PRIORITY)
    period = 1.0 / rate
    due = time.monotonic() + period
    woken: list[tuple[float, float, float]] = []
    while not ended and os.getppid() == parent:
        time.sleep(max(0.0, due - time.monotonic()))
        now = time.monotonic()
        work()
        woken.append((due, now - due, time.monotonic() - now))
        due = due + period if now < due + period else now + period
    json.dump(woken, sys.stdout)


if __name__ == "__main__":
    main()
