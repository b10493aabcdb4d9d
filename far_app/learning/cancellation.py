"""How a background adaptation is told to end: it looks at `cancelled` before every pass of the denoiser, and
between its layers on the way back."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import TypeVar

T = TypeVar("T")

Cancelled = Callable[[], bool]
"""True once nobody waits for the result any more."""


class AdaptationCancelledError(Exception):
    """Unwinds an adaptation that nobody waits for; never leaves Method.adapt."""


def check(cancelled: Cancelled) -> None:
    """Raise when the adaptation is no longer wanted. Called some 20 ms apart at most."""
    if cancelled():
        raise AdaptationCancelledError


def abandonable(call: Callable[[], T], cancelled: Cancelled) -> T:
    """The result of a call that cannot look for itself (a compiler's); when the adaptation is no longer wanted it is
    left to end alone, in its own thread, and its result is dropped. The program's end waits for it: a thread inside a
    compiler or torch at the interpreter's end would abort it."""
    result: Future[T] = Future()

    def work() -> None:
        try:
            result.set_result(call())
        except BaseException as error:
            result.set_exception(error)

    threading.Thread(target=work, name="adaptation-engine").start()
    while not wait((result,), timeout=_LOOK).done:
        check(cancelled)
    return result.result()


_LOOK = 0.02
"""Seconds between two looks."""


def never() -> bool:
    return False
