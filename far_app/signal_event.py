"""An event that a signal handler may set."""

from __future__ import annotations

import contextlib
import signal
from queue import Empty, SimpleQueue


class SignalSafeEvent:
    """As threading.Event, set once. A handler interrupts whatever its thread is doing, set() and wait() themselves
    included, where a threading.Event would wait for its own lock for ever; here there is none to hold."""

    def __init__(self) -> None:
        self._set = False
        self._news: SimpleQueue[None] = SimpleQueue()

    def set(self) -> None:
        self._set = True
        self._news.put(None)

    def is_set(self) -> bool:
        return self._set

    def wait(self, timeout: float) -> bool:
        """Sleep until it is set, or for so many seconds; whether it is set."""
        if not self._set:
            with contextlib.suppress(Empty):
                self._news.get(timeout=timeout)
        return self._set

    def set_on(self, *signals: signal.Signals) -> SignalSafeEvent:
        """Set by these signals from now on."""
        for number in signals:
            signal.signal(number, lambda *_: self.set())
        return self
