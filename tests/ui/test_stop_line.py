"""STOP's line, from the page's process to the hw server, by itself."""

from __future__ import annotations

import ctypes
import os
import threading
import time
from pathlib import Path

import pytest
from ui_stage import Stage

from far_app.endpoints import Endpoints
from far_app.scheduling import real_time
from ui.stop import StopLine


def policies() -> dict[int, int]:
    """Scheduling of the threads of STOP's lines and of the message library; not of what else the process runs."""
    lines = {thread.native_id for thread in threading.enumerate() if thread.name == "stop-line"}
    return {
        int(task.name): os.sched_getscheduler(int(task.name)) & ~os.SCHED_RESET_ON_FORK
        for task in Path("/proc/self/task").iterdir()
        if int(task.name) in lines or (task / "comm").read_text().startswith("ZMQbg")
    }


def note_of_the_scheduling() -> None:
    """Asks the C library how this thread is scheduled: from then on the threads started here take its answer along."""
    c = ctypes.CDLL(None)
    c.pthread_self.restype = ctypes.c_ulong
    policy, priority = ctypes.c_int(), ctypes.c_int()
    assert c.pthread_getschedparam(ctypes.c_ulong(c.pthread_self()), ctypes.byref(policy), ctypes.byref(priority)) == 0


def test_no_thread_of_the_line_waits_for_a_core_behind_other_programs(folder: Path, stage: Stage) -> None:
    granted: list[str] = []
    asking = threading.Thread(target=lambda: granted.append(real_time(1)))
    asking.start()
    asking.join()
    if granted != ["fifo"]:
        pytest.skip("real time is not permitted here")
    note_of_the_scheduling()  # as a library in the page's process may have done
    before = policies()
    line = StopLine(Endpoints.in_folder(folder))
    line.press("test")
    deadline = time.monotonic() + 5.0
    while not (line.result is not None and line.result.latched) and time.monotonic() < deadline:
        time.sleep(0.01)
    new = [policy for thread, policy in policies().items() if thread not in before]
    assert line.result is not None and line.result.latched
    assert len(new) == 3 and set(new) == {os.SCHED_FIFO}, "the line's own, and two of its messages"
    line.close()
