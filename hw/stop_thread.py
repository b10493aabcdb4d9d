"""STOP's own thread, context and socket: latches at once, whatever else hangs."""

from __future__ import annotations

import logging
import threading
import time

import zmq

from far_app.endpoints import Endpoints
from far_app.errors import RobotError
from far_app.scheduling import STOP_PRIORITY, prompt_context, real_time
from far_app.telemetry import StopAck, StopRequest
from far_app.wire import WireError, pack, unpack
from hw.servo_thread import ServoThread

log = logging.getLogger(__name__)


class StopThread:
    """Answers StopRequest with StopAck. Whatever else arrives on this socket is taken for a STOP as well."""

    def __init__(self, servo: ServoThread, endpoints: Endpoints) -> None:
        self._servo, self._endpoint = servo, endpoints.stop
        self._context = prompt_context()
        self._gate = endpoints.secure(self._context)
        self._bound = threading.Event()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="stop", daemon=True)

    def start(self) -> None:
        self._thread.start()
        if not self._bound.wait(5.0):
            raise RobotError(f"cannot listen for STOP at {self._endpoint}; is another hw server running?")

    def close(self) -> None:
        self._closing = True
        self._thread.join(timeout=2.0)
        if self._gate is not None:
            self._gate.close()
        self._context.destroy(linger=0)

    def _run(self) -> None:
        real_time(STOP_PRIORITY)
        socket = self._context.socket(zmq.REP)
        socket.setsockopt(zmq.LINGER, 100)
        socket.bind(self._endpoint)
        self._bound.set()
        while not self._closing:
            if not socket.poll(100):
                continue
            raw = socket.recv()
            latched = time.monotonic()
            self._servo.stop("STOP")  # first of all: on a real arm this puts the frame on the wire
            socket.send(pack(StopAck(latched=latched)), zmq.NOBLOCK)
            try:
                request = unpack(raw)
                source = request.source if isinstance(request, StopRequest) else "an unknown message"
            except WireError:
                source = "an unreadable message"
            log.warning("STOP from %s", source)
        socket.close()
