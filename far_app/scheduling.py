"""Who runs before whom, in every process of a run. Asked for, and done without where the system does not permit it.

Real time (SCHED_FIFO) is for what runs a moment and must not wait its turn; the higher number goes first:

    STOP 21 · servo 20 · messages between app and arm 15 · the app's loop 10 · what serves it in its interpreter 6 ·
    the rest of a real arm's hw server 5

The rest share the cores by niceness; a thread that runs Python beside one of the above holds its interpreter, and must
itself not wait long for a core: the loop then waits for the interpreter as long as its holder waits for its turn. So
the app's recorder, its telemetry and those who read for it are real time too: the hw server of a real arm, all of it
real time, would keep them waiting, and the loop with them. In that server STOP could be kept waiting so: there all are
(`real_time_from_here`).
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import threading
from collections.abc import Iterator

import zmq

STOP_PRIORITY = 21
SERVO_PRIORITY = 20
MESSAGE_PRIORITY = 15
LOOP_PRIORITY = 10
SERVING_PRIORITY = 6
"""Of threads that do little and often hold the loop's interpreter: recorder, telemetry, observations, intents."""
HARDWARE_PRIORITY = 5

SERVO_NICENESS = -15
PROMPT_NICENESS = -10
"""Of threads beside a real-time one, and of those where real time is not permitted."""
DRAWING_NICENESS = -5
"""Of the GL driver's worker threads: before anything on the machine that did not ask, after the loop."""
BACKGROUND_NICENESS = -5
"""Of learning: after all that drives the arm, but no lower, for between its operations it holds the interpreter."""

SWITCH_INTERVAL = 1e-4
"""Seconds a thread that wants the interpreter waits before it asks the holder for it (sys.setswitchinterval)."""
KEEP_INTERVAL = 1e-3
"""The same between a tick's deadline and its target: the loop's few lines are not to be taken apart by others."""

MOST_LEARNING = 4
"""Threads that learn at once where there are many cores: an update is rarely cut into more pieces."""

_PR_SET_TIMERSLACK = 29
_TIMER_SLACK_NS = 1000


def learning_threads() -> int:
    """As many as there are cores for this process, up to MOST_LEARNING: the arm needs little of them on its way home,
    and goes first."""
    return min(len(os.sched_getaffinity(0)), MOST_LEARNING)


def nice(niceness: int) -> bool:
    """The calling thread's own niceness (Linux threads have one each); False where not permitted."""
    try:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)
    except (OSError, AttributeError):
        return False
    return True


def nice_threads(niceness: int) -> bool:
    """The niceness of every thread that this process has so far, those of libraries too; later ones begin with that of
    the thread that starts them. False where not permitted."""
    try:
        for thread in os.listdir("/proc/self/task"):
            with contextlib.suppress(ProcessLookupError):
                os.setpriority(os.PRIO_PROCESS, int(thread), niceness)
    except OSError:
        return False
    return True


def real_time(priority: int, niceness: int = PROMPT_NICENESS) -> str:
    """The best the calling thread can get: "fifo", "nice" or "normal"; and timers exact to a microsecond. Threads and
    processes that it starts begin at the usual priority."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_TIMERSLACK, _TIMER_SLACK_NS, 0, 0, 0)
    if _schedule(priority, inherited=False):
        return "fifo"
    return "nice" if nice(niceness) else "normal"


def real_time_from_here(priority: int) -> bool:
    """Real time for the calling thread and for every thread it starts from now on, theirs too; False where not
    permitted."""
    return _schedule(priority, inherited=True)


@contextlib.contextmanager
def real_time_inside(priority: int, niceness: int = PROMPT_NICENESS) -> Iterator[str]:
    """The same for a while; what it began with is given back (its niceness only if real time was permitted)."""
    scheduling = real_time(priority, niceness)
    try:
        yield scheduling
    finally:
        if scheduling == "fifo":
            # the flag stays: without privilege a thread may lower its priority but not take that flag back
            os.sched_setscheduler(threading.get_native_id(), os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))


def prompt_context() -> zmq.Context[zmq.Socket[bytes]]:
    """A ZeroMQ context whose own thread carries messages at MESSAGE_PRIORITY, so that one between app and arm does not
    wait behind inference for a core."""
    made: list[zmq.Context[zmq.Socket[bytes]]] = []

    def make() -> None:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context(io_threads=1)
        real_time_from_here(MESSAGE_PRIORITY)
        context.socket(zmq.PAIR).close()  # the first socket starts the context's thread, which inherits the priority
        made.append(context)

    thread = threading.Thread(target=make, name="prompt-context")
    thread.start()
    thread.join()
    return made[0]


def _schedule(priority: int, inherited: bool) -> bool:
    """Real time for the calling thread, and for the threads it starts or not; False where not permitted."""
    try:
        policy = os.SCHED_FIFO | (0 if inherited else os.SCHED_RESET_ON_FORK)
        os.sched_setscheduler(threading.get_native_id(), policy, os.sched_param(priority))
        if inherited:
            _remember(priority)
    except (OSError, AttributeError):
        return False
    return True


def _remember(priority: int) -> None:
    """Tell the C library too. It keeps its own note of a thread's scheduling once anybody asked for it, hands the note
    to the threads started from there, and libzmq's threads begin by setting what the note says: a stale one, made by
    any library in the process, would take from them what the kernel let them inherit."""
    c = ctypes.CDLL(None)
    c.pthread_self.restype = ctypes.c_ulong
    c.pthread_setschedparam.argtypes = [ctypes.c_ulong, ctypes.c_int, ctypes.POINTER(ctypes.c_int)]
    c.pthread_setschedparam(c.pthread_self(), os.SCHED_FIFO, ctypes.byref(ctypes.c_int(priority)))
