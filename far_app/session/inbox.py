"""What the operator asked for: intents from the page (ZeroMQ PULL) and from signals, drained once a tick."""

from __future__ import annotations

import logging
import queue
import threading
import time
from typing import Any, TypeVar

import zmq

from far_app.lineage import VersionWish
from far_app.marks import MarkAttempt
from far_app.scheduling import SERVING_PRIORITY, real_time
from far_app.session_states import Intent
from far_app.take_over import Nudge
from far_app.telemetry import OperatorIntent, PagePresence
from far_app.what_if import CorrectFlag
from far_app.wire import WireError, unpack

log = logging.getLogger(__name__)

WORDS = (CorrectFlag, Nudge, MarkAttempt, VersionWish)
"""What the page may say besides an intent."""
_W = TypeVar("_W")


class IntentInbox:
    """A queue that any thread may fill; with an endpoint, a thread of its own fills it from the page."""

    def __init__(self, endpoint: str | None = None) -> None:
        self._queue: queue.SimpleQueue[Intent] = queue.SimpleQueue()
        self._words: dict[type, queue.SimpleQueue[Any]] = {kind: queue.SimpleQueue() for kind in WORDS}
        self.looked_at = time.monotonic()
        """When somebody was last known to have the page open."""
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        if endpoint is not None:
            self._socket = zmq.Context.instance().socket(zmq.PULL)
            self._socket.setsockopt(zmq.RCVHWM, 100)
            self._socket.bind(endpoint)
            self._thread = threading.Thread(target=self._receive, name="intents", daemon=True)
            self._thread.start()

    def put(self, intent: Intent) -> None:
        self._queue.put(intent)

    def drain(self) -> list[Intent]:
        """All that arrived since the last call, oldest first; never waits."""
        intents = []
        while not self._queue.empty():
            intents.append(self._queue.get_nowait())
        return intents

    def say(self, word: CorrectFlag | Nudge | MarkAttempt | VersionWish) -> None:
        """One of WORDS, from any thread."""
        self._words[type(word)].put(word)

    def take(self, kind: type[_W]) -> list[_W]:
        """The operator's words of this kind since the last call, oldest first; never waits."""
        words: list[_W] = []
        while not self._words[kind].empty():
            words.append(self._words[kind].get_nowait())
        return words

    def close(self) -> None:
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
            self._socket.close(linger=0)

    def _receive(self) -> None:
        real_time(SERVING_PRIORITY)
        while not self._closing.is_set():
            if not self._socket.poll(100):
                continue
            try:
                message = unpack(self._socket.recv())
            except WireError as error:
                log.warning("an intent was dropped: %s", error)
                continue
            if isinstance(message, OperatorIntent):
                log.info("operator: %s", message.intent)
                self._queue.put(message.intent)
            elif isinstance(message, WORDS):
                if isinstance(message, Nudge):
                    self.looked_at = time.monotonic()  # a press: somebody is there
                self.say(message)
            elif isinstance(message, PagePresence) and message.clients > 0:
                self.looked_at = time.monotonic()
