"""An event that signals set while they interrupt its own set() and wait()."""

import signal
import subprocess
import sys

from far_app.signal_event import SignalSafeEvent

STORM = """
import signal, time
from far_app.signal_event import SignalSafeEvent
events = [SignalSafeEvent()]
signal.signal(signal.SIGALRM, lambda *_: events[-1].set())
signal.setitimer(signal.ITIMER_REAL, 2e-4, 2e-4)
end = time.monotonic() + 2.0
while time.monotonic() < end:
    events.append(SignalSafeEvent())
    events[-1].set()
    assert events[-1].wait(5.0)
    events.append(SignalSafeEvent())
    assert events[-1].wait(5.0), "a signal was not heard"
signal.setitimer(signal.ITIMER_REAL, 0)
print(len(events))
"""


def test_signals_in_the_midst_of_set_and_wait_set_it_all_the_same() -> None:
    done = subprocess.run([sys.executable, "-c", STORM], capture_output=True, text=True, timeout=60, check=True)
    assert int(done.stdout) > 100


def test_it_waits_no_longer_than_it_is_asked_to() -> None:
    event = SignalSafeEvent()
    assert not event.wait(0.01)
    assert not event.is_set()
    event.set()
    assert event.is_set()
    assert all(event.wait(10.0) for _ in range(3))


def test_the_signals_it_hears() -> None:
    before = signal.getsignal(signal.SIGUSR1)
    try:
        event = SignalSafeEvent().set_on(signal.SIGUSR1)
        signal.raise_signal(signal.SIGUSR1)
        assert event.is_set()
    finally:
        signal.signal(signal.SIGUSR1, before)
