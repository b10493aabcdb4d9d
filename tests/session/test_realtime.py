"""Whose turn the interpreter is."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest

from far_app.scheduling import KEEP_INTERVAL, SWITCH_INTERVAL
from far_app.session.realtime import keep_interpreter, share_interpreter


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    interval = sys.getswitchinterval()
    yield
    sys.setswitchinterval(interval)


def test_in_a_prepared_process_the_interpreter_is_kept_until_it_is_shared_again():
    sys.setswitchinterval(SWITCH_INTERVAL)
    keep_interpreter()
    assert sys.getswitchinterval() == pytest.approx(KEEP_INTERVAL)
    keep_interpreter()
    share_interpreter()
    assert sys.getswitchinterval() == pytest.approx(SWITCH_INTERVAL)


def test_a_process_that_asked_for_no_short_turns_keeps_its_own():
    sys.setswitchinterval(0.005)
    keep_interpreter()
    share_interpreter()
    assert sys.getswitchinterval() == 0.005
