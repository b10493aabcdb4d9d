"""What keeps a Python loop on time beside its priority: a short switch interval, the collector outside attempts."""

from __future__ import annotations

import contextlib
import gc
import sys

from far_app.scheduling import SWITCH_INTERVAL


def prepare_process(torch_threads: int) -> None:
    """Once, after the models are loaded and before any loop: torch's threads, a short switch interval, and what is
    loaded frozen out of the collector's sight."""
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(torch_threads)
    sys.setswitchinterval(SWITCH_INTERVAL)
    gc.collect()
    gc.freeze()


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
