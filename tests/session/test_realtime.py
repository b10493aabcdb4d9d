"""What the loop asks of the system's scheduler, it gives back, and nothing it starts inherits it."""

import os
import threading

from far_app.session.realtime import loop_priority


def policy() -> int:
    return os.sched_getscheduler(threading.get_native_id()) & ~os.SCHED_RESET_ON_FORK


def test_the_loops_priority_is_its_own_and_ends_with_it():
    before, inherited = policy(), []
    with loop_priority() as scheduling:
        assert policy() == (os.SCHED_FIFO if scheduling == "fifo" else before)
        thread = threading.Thread(target=lambda: inherited.append(policy()))
        thread.start()
        thread.join()
    assert policy() == before
    assert inherited == [os.SCHED_OTHER]


def test_without_the_right_it_asks_for_what_it_may_have(monkeypatch):
    def refused(*arguments):
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refused)
    monkeypatch.setattr(os, "setpriority", refused)
    with loop_priority() as scheduling:
        assert scheduling == "normal"
