"""What nobody waits for any more ends soon, whatever it is doing."""

from __future__ import annotations

import subprocess
import sys
import threading
import time

import pytest

from far_app.errors import FarError
from far_app.learning.cancellation import AdaptationCancelledError, abandonable, never


def test_a_call_that_cannot_look_is_left_behind():
    release, ended = threading.Event(), threading.Event()

    def deaf() -> None:
        release.wait(10)
        ended.set()

    began = time.monotonic()
    with pytest.raises(AdaptationCancelledError):
        abandonable(deaf, lambda: time.monotonic() > began + 0.05)
    assert not ended.is_set()
    release.set()
    assert ended.wait(5), "it ends alone"


QUITS = """
import time, torch
from far_app.learning.cancellation import AdaptationCancelledError, abandonable

a = torch.zeros(400, 400)

def deaf():
    end = time.monotonic() + 1.0
    while time.monotonic() < end:
        torch.mm(a, a)

try:
    abandonable(deaf, lambda: True)
except AdaptationCancelledError:
    print("left", flush=True)
"""


def test_a_program_that_quits_in_the_meantime_ends_well():
    """As when the operator ends the session while a new engine is compiled."""
    done = subprocess.run([sys.executable, "-c", QUITS], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "left\n", "")


def test_results_and_errors_come_through():
    assert abandonable(lambda: 7, never) == 7

    def fails() -> None:
        raise FarError("no engine")

    with pytest.raises(FarError, match="no engine"):
        abandonable(fails, never)

    def times_out() -> None:
        raise TimeoutError("of its own")

    with pytest.raises(TimeoutError, match="of its own"):
        abandonable(times_out, never)
