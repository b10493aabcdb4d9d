"""What keeps a Python loop on time beside its priority: who has the interpreter, the collector outside attempts."""

from __future__ import annotations

import contextlib
import gc
import math
import sys

from far_app.scheduling import KEEP_INTERVAL, SWITCH_INTERVAL


def prepare_process(torch_threads: int) -> None:
    """Once, after the models are loaded and before any loop: torch's threads, a short switch interval, and what is
    loaded frozen out of the collector's sight."""
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(torch_threads)
    sys.setswitchinterval(SWITCH_INTERVAL)
    gc.collect()
    gc.freeze()


def keep_interpreter() -> None:
    """In a prepared process, from now on others wait longer before they ask for the interpreter. For the one loop of a
    process, and for a moment: each turn taken in between would be some tenths of a ms until it comes back."""
    if sys.getswitchinterval() < KEEP_INTERVAL:
        sys.setswitchinterval(KEEP_INTERVAL)


def share_interpreter() -> None:
    """As usual again."""
    if math.isclose(sys.getswitchinterval(), KEEP_INTERVAL):
        sys.setswitchinterval(SWITCH_INTERVAL)


@contextlib.contextmanager
def collector_off():
    """No collection inside; `collect_between` is called where a pause of some ms does no harm."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def collect_between() -> None:
    """A collection of the young, at an attempt's end."""
    gc.collect(1)
