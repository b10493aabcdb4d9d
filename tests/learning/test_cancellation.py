"""What nobody waits for any more ends soon, whatever it is doing."""

from __future__ import annotations

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
