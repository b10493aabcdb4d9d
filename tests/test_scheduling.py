"""What a thread asks of the system's scheduler, it gives back, and nothing it starts inherits it."""

import os
import threading

import zmq

from far_app import scheduling
from far_app.scheduling import LOOP_PRIORITY, nice_threads, prompt_context, real_time_inside


def policy() -> int:
    return os.sched_getscheduler(threading.get_native_id()) & ~os.SCHED_RESET_ON_FORK


def test_real_time_is_its_own_and_ends_with_it():
    before, inherited = policy(), []
    with real_time_inside(LOOP_PRIORITY) as got:
        assert policy() == (os.SCHED_FIFO if got == "fifo" else before)
        thread = threading.Thread(target=lambda: inherited.append(policy()))
        thread.start()
        thread.join()
    assert policy() == before
    assert inherited == [os.SCHED_OTHER]


def test_without_the_right_it_asks_for_what_it_may_have(monkeypatch):
    refuse(monkeypatch)
    with real_time_inside(LOOP_PRIORITY) as got:
        assert got == "normal"


def test_a_prompt_context_carries_messages_with_and_without_the_right(monkeypatch):
    for _ in range(2):
        context = prompt_context()
        a, b = context.socket(zmq.PAIR), context.socket(zmq.PAIR)
        port = a.bind_to_random_port("tcp://127.0.0.1")
        b.connect(f"tcp://127.0.0.1:{port}")
        b.send(b"hello")
        assert a.poll(2000)
        assert a.recv() == b"hello"
        assert policy() == os.SCHED_OTHER, "the priority was the context's, not ours"
        context.destroy(linger=0)
        refuse(monkeypatch)


def test_the_niceness_of_all_threads_is_that_of_those_already_there_too(monkeypatch):
    told, go_on = [], threading.Event()

    def wait() -> None:
        go_on.wait(10)
        told.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))

    thread = threading.Thread(target=wait)
    thread.start()
    allowed = nice_threads(-1)
    go_on.set()
    thread.join()
    assert told == [-1 if allowed else 0]
    nice_threads(0)
    refuse(monkeypatch)
    assert not nice_threads(-1)


def refuse(monkeypatch) -> None:
    def refused(*arguments):
        raise PermissionError

    monkeypatch.setattr(scheduling.os, "sched_setscheduler", refused)
    monkeypatch.setattr(scheduling.os, "setpriority", refused)
