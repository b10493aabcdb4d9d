"""STOP's own line to the hw server: its own thread, socket and context, so that nothing else can delay it."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from dataclasses import dataclass

import zmq

from far_app.endpoints import Endpoints
from far_app.scheduling import STOP_PRIORITY, prompt_context, real_time
from far_app.telemetry import StopAck, StopRequest
from far_app.wire import WireError, pack, unpack

PATIENCE = 0.3
"""Seconds to wait for the latch to be confirmed before asking again on a fresh socket."""
TRIES = 10


@dataclass(frozen=True, kw_only=True)
class StopResult:
    pressed: float
    """Monotonic seconds of the press."""
    latched: bool | None
    """None while under way."""
    latency_ms: float = float("nan")
    """From the press until the hw server's word that it latched was heard here."""
    heard: float = float("nan")
    """Monotonic seconds of the hw server at which it heard of it."""
    tries: int = 0


class StopLine:
    """press() returns at once and may be called from any thread; result tells how it went."""

    def __init__(self, endpoints: Endpoints) -> None:
        self._endpoints = endpoints
        self._pressed = threading.Event()
        self._closing = False
        self._source = ""
        self._since = 0.0
        self.result: StopResult | None = None
        self._thread = threading.Thread(target=self._serve, name="stop-line", daemon=True)
        self._thread.start()

    def press(self, source: str) -> None:
        self._source, self._since = source, time.monotonic()
        self._pressed.set()

    def close(self) -> None:
        self._closing = True
        self._pressed.set()
        self._thread.join(timeout=1.0)

    def _serve(self) -> None:
        real_time(STOP_PRIORITY)  # niceness would not do: it says nothing to the programs of another session
        context = prompt_context()
        self._endpoints.secure(context)
        socket = self._connected(context)
        while True:
            self._pressed.wait()
            self._pressed.clear()
            if self._closing:
                break
            self.result = StopResult(pressed=self._since, latched=None)
            socket, self.result = self._stop(context, socket, self._since)
        context.destroy(linger=0)

    def _connected(self, context: zmq.Context[zmq.Socket[bytes]]) -> zmq.Socket[bytes]:
        """A connection that stands before STOP is pressed: between two machines its handshake takes its time."""
        socket = context.socket(zmq.REQ)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RCVTIMEO, int(1000 * PATIENCE))
        socket.setsockopt(zmq.SNDTIMEO, int(1000 * PATIENCE))
        socket.connect(self._endpoints.stop)
        return socket

    def _stop(
        self, context: zmq.Context[zmq.Socket[bytes]], socket: zmq.Socket[bytes], pressed: float
    ) -> tuple[zmq.Socket[bytes], StopResult]:
        """Ask until it is confirmed, each time on a fresh socket: a REQ that timed out can never be used again. Returns
        the socket for the next time."""
        request = pack(StopRequest(source=self._source, stamp=pressed))
        for attempt in range(1, TRIES + 1):
            if (answer := self._ask(socket, request)) is not None:
                return socket, StopResult(
                    pressed=pressed, latched=True, latency_ms=1000 * (time.monotonic() - pressed), heard=answer.latched,
                    tries=attempt,
                )  # fmt: skip
            socket.close()
            socket = self._connected(context)
            if self._closing:
                break
        return socket, StopResult(pressed=pressed, latched=False, tries=TRIES)

    def _ask(self, socket: zmq.Socket[bytes], request: bytes) -> StopAck | None:
        try:
            socket.send(request)
            answer = unpack(socket.recv())
        except (zmq.ZMQError, WireError):
            return None
        return answer if isinstance(answer, StopAck) else None


def hasten(thread: int) -> None:
    """Let a thread (native id) run before ordinary work where we may: a busy machine must not delay STOP."""
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, thread, -10)
