"""What the page hears and says: newest telemetry and view, the scene's geometry, intents. One thread, no waiting."""

from __future__ import annotations

import contextlib
import logging
import time
from typing import Any

import zmq

from far_app.endpoints import Endpoints
from far_app.session_states import Intent
from far_app.telemetry import GeometryRequest, OperatorIntent, PagePresence, SceneGeometry, Telemetry, View
from far_app.wire import WireError, pack, unpack

log = logging.getLogger(__name__)

GEOMETRY_RETRY = 2.0
"""Seconds after which an unanswered request for the geometry is given up and asked again."""
TAKE = 300
"""Milliseconds."""


class Latest:
    """The newest message of one publisher; older ones are dropped by the socket and counted here."""

    def __init__(self, context: zmq.Context[Any], endpoint: str, kind: type) -> None:
        self._kind = kind
        self._socket = context.socket(zmq.SUB)
        self._socket.setsockopt(zmq.CONFLATE, 1)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.subscribe(b"")
        self._socket.connect(endpoint)
        self.message: Any = None
        self.dropped = 0
        """Messages published but never read: latest wins."""
        self._heard: float | None = None

    def poll(self) -> bool:
        """Take the newest message, if one came; True when it did."""
        try:
            raw = self._socket.recv(zmq.NOBLOCK)
        except zmq.Again:
            return False
        try:
            message = unpack(raw)
        except WireError as error:
            log.warning("refused a message: %s", error)
            return False
        if not isinstance(message, self._kind):
            log.warning("refused a %s where a %s belongs", type(message).__name__, self._kind.__name__)
            return False
        if self.message is not None and message.seq > self.message.seq:
            self.dropped += message.seq - self.message.seq - 1
        self.message = message
        self._heard = time.monotonic()
        return True

    def age(self) -> float | None:
        """Seconds since the last message; None before the first."""
        return None if self._heard is None else time.monotonic() - self._heard

    def close(self) -> None:
        self._socket.close()


class Geometry:
    """Asks the hw server what to draw until it answers once."""

    def __init__(self, context: zmq.Context[Any], endpoint: str) -> None:
        self._context, self._endpoint = context, endpoint
        self._socket: zmq.Socket[bytes] | None = None
        self._asked = 0.0
        self.done = False

    def poll(self) -> SceneGeometry | None:
        """The answer, in the call in which it arrives."""
        if self.done:
            return None
        if self._socket is None or time.monotonic() - self._asked > GEOMETRY_RETRY:
            self._ask()
            return None
        try:
            answer = unpack(self._socket.recv(zmq.NOBLOCK))
        except zmq.Again:
            return None
        except WireError as error:
            log.warning("the hw server's geometry is unreadable: %s", error)
            return None
        if not isinstance(answer, SceneGeometry):
            return None
        self.done = True
        self.close()
        return answer

    def again(self) -> None:
        """Ask anew: the hw server has been restarted."""
        self.done = False

    def _ask(self) -> None:
        self.close()
        self._socket = socket = self._context.socket(zmq.REQ)
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(self._endpoint)
        socket.send(pack(GeometryRequest()))
        self._asked = time.monotonic()

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class Feeds:
    """All the page's sockets but STOP's own."""

    def __init__(self, endpoints: Endpoints) -> None:
        self._context = zmq.Context(io_threads=1)
        self._hardware: zmq.Context[Any] = zmq.Context(io_threads=1)
        endpoints.secure(self._hardware)
        self.telemetry = Latest(self._context, endpoints.telemetry, Telemetry)
        self.view = Latest(self._hardware, endpoints.view, View)
        self.geometry = Geometry(self._hardware, endpoints.geometry)
        self._intents = self._context.socket(zmq.PUSH)
        self._intents.setsockopt(zmq.LINGER, 0)
        self._intents.setsockopt(zmq.SNDHWM, 8)
        self._intents.setsockopt(zmq.IMMEDIATE, 1)
        self._intents.connect(endpoints.intents)

    def send(self, said: Any, operator: str) -> bool:
        """Hand an intent, or another registered word, to the app; False when nobody takes it (then it is dropped, never
        sent late). Waits TAKE at most: this socket finds an app that has just begun to listen a moment after the app's
        own words arrive here."""
        try:
            is_intent = isinstance(said, Intent)
            message = OperatorIntent(intent=said, operator=operator, stamp=time.monotonic()) if is_intent else said
            self._intents.poll(TAKE, zmq.POLLOUT)
            self._intents.send(pack(message), zmq.NOBLOCK)
        except zmq.Again:
            return False
        return True

    def present(self, clients: int) -> None:
        """Tell the app how many look at the page; lost where nobody takes it."""
        with contextlib.suppress(zmq.Again):
            self._intents.send(pack(PagePresence(clients=clients)), zmq.NOBLOCK)

    def close(self) -> None:
        self.telemetry.close()
        self.view.close()
        self.geometry.close()
        self._intents.close()
        self._context.term()
        self._hardware.term()
