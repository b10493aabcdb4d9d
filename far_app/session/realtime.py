"""What keeps a Python loop on time: thread priorities, a short switch interval, the collector outside attempts."""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import threading
from collections.abc import Iterator

LOOP_PRIORITY = 10
"""SCHED_FIFO priority of the loop's thread, below the servo thread's: it runs 1 ms of 33 and must not wait its turn."""
LOOP_NICENESS = -10
"""Of every thread of the app that runs Python beside the loop (and of the loop where real time is not permitted): one
that is not scheduled while it holds the interpreter would keep the loop waiting."""
INFERENCE_NICENESS = -10
BACKGROUND_NICENESS = 10


def set_niceness(niceness: int) -> bool:
    """The calling thread's own niceness (Linux threads have one each); False where the system does not permit it."""
    try:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)
    except (OSError, AttributeError):
        return False
    return True


@contextlib.contextmanager
def loop_priority() -> Iterator[str]:
    """The best the calling thread can get while inside: "fifo", "nice" or "normal". Threads and processes started
    inside begin at the usual priority."""
    thread = threading.get_native_id()
    try:
        os.sched_setscheduler(thread, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(LOOP_PRIORITY))
    except (OSError, AttributeError):
        yield "nice" if set_niceness(LOOP_NICENESS) else "normal"
        return
    try:
        yield "fifo"
    finally:
        # the flag stays: without privilege a thread may lower its priority but not take that flag back
        os.sched_setscheduler(thread, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))


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
