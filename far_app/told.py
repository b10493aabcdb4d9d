"""Whether this process was told to end."""

from __future__ import annotations

import contextlib
import signal
from queue import Empty, SimpleQueue


class Told:
    """Told by anybody, a signal handler included. That interrupts whatever its thread is doing, the telling and the
    waiting themselves too, where a threading.Event would wait for its own lock for ever; here there is none to hold."""

    def __init__(self) -> None:
        self._told = False
        self._news: SimpleQueue[None] = SimpleQueue()

    def set(self) -> None:
        self._told = True
        self._news.put(None)

    def is_set(self) -> bool:
        return self._told

    def wait(self, timeout: float) -> bool:
        """Sleep until told, or for so many seconds; whether it was told."""
        if not self._told:
            with contextlib.suppress(Empty):
                self._news.get(timeout=timeout)
        return self._told

    def at(self, *signals: signal.Signals) -> Told:
        """Told by these signals from now on."""
        for number in signals:
            signal.signal(number, lambda *_: self.set())
        return self
