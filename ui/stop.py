"""STOP's own line to the hw server: its own thread, socket and context, so that nothing else can delay it."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from dataclasses import dataclass

import zmq

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
    """From the press to the latch in the hw server."""
    tries: int = 0


class StopLine:
    """press() returns at once and may be called from any thread; result tells how it went."""

    def __init__(self, endpoint: str) -> None:
        self._endpoint = endpoint
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
        hasten(threading.get_native_id())
        context = zmq.Context(io_threads=1)
        while True:
            self._pressed.wait()
            self._pressed.clear()
            if self._closing:
                break
            self.result = StopResult(pressed=self._since, latched=None)
            self.result = self._stop(context, self._since)
        context.destroy(linger=0)

    def _stop(self, context: zmq.Context[zmq.Socket[bytes]], pressed: float) -> StopResult:
        request = pack(StopRequest(source=self._source, stamp=pressed))
        for attempt in range(1, TRIES + 1):
            answer = self._ask(context, request)
            if answer is not None:
                latency = 1000 * max(0.0, answer.latched - pressed)
                return StopResult(pressed=pressed, latched=True, latency_ms=latency, tries=attempt)
            if self._closing:
                break
        return StopResult(pressed=pressed, latched=False, tries=TRIES)

    def _ask(self, context: zmq.Context[zmq.Socket[bytes]], request: bytes) -> StopAck | None:
        """One try on a fresh REQ socket: a REQ that timed out can never be used again."""
        socket = context.socket(zmq.REQ)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RCVTIMEO, int(1000 * PATIENCE))
        socket.setsockopt(zmq.SNDTIMEO, int(1000 * PATIENCE))
        try:
            socket.connect(self._endpoint)
            socket.send(request)
            answer = unpack(socket.recv())
        except (zmq.ZMQError, WireError):
            return None
        finally:
            socket.close()
        return answer if isinstance(answer, StopAck) else None


def hasten(thread: int) -> None:
    """Let a thread (native id) run before ordinary work where we may: a busy machine must not delay STOP."""
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, thread, -10)
