"""Waiting, in benchmarks, for what other threads and processes bring about."""

from __future__ import annotations

import time
from collections.abc import Callable

LOOK = 0.005
"""Seconds between two looks."""


def came_true(what: Callable[[], bool], seconds: float) -> bool:
    """Whether it did within so long."""
    deadline = time.monotonic() + seconds
    while not what():
        if time.monotonic() > deadline:
            return False
        time.sleep(LOOK)
    return True
