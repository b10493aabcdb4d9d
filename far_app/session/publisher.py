"""Telemetry to the page at 15 Hz from a thread of its own; the loop only leaves its newest snapshot here."""

from __future__ import annotations

import dataclasses
import itertools
import threading
import time
from collections.abc import Callable

import zmq

from far_app.scheduling import SERVING_PRIORITY, real_time
from far_app.telemetry import LoopHealth, Telemetry
from far_app.wire import Packer

RATE = 15.0
"""Snapshots a second."""


class TelemetryPublisher:
    """Latest wins: a snapshot that nobody fetched in time is replaced, never queued."""

    def __init__(self, endpoint: str, health: Callable[[], LoopHealth]) -> None:
        self._health = health
        self._newest: Telemetry | None = None
        self._seq = itertools.count(1)
        self._closing = threading.Event()
        self._socket = zmq.Context.instance().socket(zmq.PUB)
        self._socket.setsockopt(zmq.SNDHWM, 2)
        self._socket.bind(endpoint)
        self._thread = threading.Thread(target=self._publish, name="telemetry", daemon=True)
        self._thread.start()

    def show(self, telemetry: Telemetry) -> None:
        """Replace the snapshot; returns at once."""
        self._newest = telemetry

    def close(self) -> None:
        """Publish the last snapshot and end."""
        self._closing.set()
        self._thread.join()
        self._socket.close(linger=200)

    def _publish(self) -> None:
        real_time(SERVING_PRIORITY)
        closing, packer = False, Packer()
        loop, next_health = LoopHealth(), 0.0
        while not closing:
            closing = self._closing.wait(1.0 / RATE)
            if time.monotonic() > next_health:
                loop, next_health = self._health(), time.monotonic() + 0.5
            newest = self._newest
            if newest is None:
                continue
            snapshot = dataclasses.replace(newest, seq=next(self._seq), stamp=time.monotonic(), loop=loop)
            self._socket.send(packer.pack(snapshot), zmq.NOBLOCK)
