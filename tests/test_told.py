"""Being told to end, by signals that interrupt the telling itself."""

import signal
import subprocess
import sys

from far_app.told import Told

STORM = """
import signal, time
from far_app.told import Told
tellings = [Told()]
signal.signal(signal.SIGALRM, lambda *_: tellings[-1].set())
signal.setitimer(signal.ITIMER_REAL, 2e-4, 2e-4)
end = time.monotonic() + 2.0
while time.monotonic() < end:
    tellings.append(Told())
    tellings[-1].set()
    assert tellings[-1].wait(5.0)
    tellings.append(Told())
    assert tellings[-1].wait(5.0), "a signal was not heard"
signal.setitimer(signal.ITIMER_REAL, 0)
print(len(tellings))
"""


def test_signals_in_the_midst_of_telling_and_waiting_end_it_all_the_same() -> None:
    done = subprocess.run([sys.executable, "-c", STORM], capture_output=True, text=True, timeout=60, check=True)
    assert int(done.stdout) > 100


def test_it_waits_no_longer_than_it_is_asked_to() -> None:
    told = Told()
    assert not told.wait(0.01)
    assert not told.is_set()
    told.set()
    assert told.is_set()
    assert all(told.wait(10.0) for _ in range(3))


def test_the_signals_it_hears() -> None:
    before = signal.getsignal(signal.SIGUSR1)
    try:
        told = Told().at(signal.SIGUSR1)
        signal.raise_signal(signal.SIGUSR1)
        assert told.is_set()
    finally:
        signal.signal(signal.SIGUSR1, before)
