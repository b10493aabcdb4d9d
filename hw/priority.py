"""Thread priorities: asked for, and quietly done without where the system does not permit them."""

from __future__ import annotations

import ctypes
import os
import threading

SERVO_PRIORITY = 20
"""SCHED_FIFO priority of the servo thread; 1 to 99."""
SERVO_NICENESS = -15
PROMPT_NICENESS = -10
"""Every thread that runs Python beside the servo thread: one that is not scheduled while it holds the interpreter
would keep the servo thread waiting."""
DRAWING_NICENESS = -5
"""The GL driver's worker threads: before anything on the machine that did not ask, after the loop."""
_PR_SET_TIMERSLACK = 29


def nice(niceness: int) -> bool:
    """The calling thread's own niceness; False where not permitted."""
    try:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)
    except OSError:
        return False
    return True


def real_time(priority: int = SERVO_PRIORITY) -> str:
    """The best the calling thread can get: "fifo", "nice" or "normal"; and timers exact to a microsecond."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_TIMERSLACK, 1000, 0, 0, 0)
    try:
        os.sched_setscheduler(threading.get_native_id(), os.SCHED_FIFO, os.sched_param(priority))
    except OSError:
        return "nice" if nice(SERVO_NICENESS) else "normal"
    return "fifo"
