"""What keeps a Python loop on time: thread priorities, a short switch interval, the collector outside attempts."""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import threading

LOOP_NICENESS = -10
INFERENCE_NICENESS = -10
BACKGROUND_NICENESS = 10


def set_niceness(niceness: int) -> bool:
    """The calling thread's own niceness (Linux threads have one each); False where the system does not permit it."""
    try:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)
    except (OSError, AttributeError):
        return False
    return True


def prepare_process(torch_threads: int) -> None:
    """Once, after the models are loaded and before any loop: torch's threads, a short switch interval, and what is
    loaded frozen out of the collector's sight."""
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(torch_threads)
    sys.setswitchinterval(0.0005)
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
