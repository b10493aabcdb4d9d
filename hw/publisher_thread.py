"""The observation publisher: newest state and pictures, at least at the policy's rate, sooner when there is news.

News are new pictures, and acknowledgments (an app judges its tick by them, so they never wait for a picture). Slow
drawing thus never hides the robot's status; `stamp` tells how old the pictures are.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable

import zmq

from far_app.device_input import DeviceInput
from far_app.scheduling import MESSAGE_PRIORITY, real_time
from far_app.wire import pack
from hw.camera_thread import Pictures
from hw.observing import observation
from hw.servo_thread import ServoThread


class PublisherThread:
    """Publishes until closed."""

    def __init__(
        self, servo: ServoThread, context: zmq.Context[zmq.Socket[bytes]], endpoint: str, rate: float,
        device: Callable[[], DeviceInput | None] = lambda: None,
    ) -> None:  # fmt: skip
        self._device = device
        self._servo, self._context, self._endpoint = servo, context, endpoint
        self._longest = 1.25 / rate
        """Seconds between two observations, with or without news."""
        self._news = threading.Condition()
        self._fresh = False
        self._pictures = Pictures(images={}, stamp=servo.newest.stamp, seq=-1)
        self._closing = False
        self._picture_times: deque[float] = deque([0.0], maxlen=3)
        self.seq = 0
        self._thread = threading.Thread(target=self._run, name="publisher", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def pictures(self, pictures: Pictures) -> None:
        """New pictures, from the camera thread."""
        self._pictures = pictures
        self.wake()

    def wake(self) -> None:
        """There is something to tell."""
        with self._news:
            self._fresh = True
            self._news.notify()

    def lead(self, due: float) -> float:
        """Seconds from the publication of the newest pictures before this moment to the moment."""
        return min((due - t for t in list(self._picture_times) if t <= due), default=math.nan)

    def close(self) -> None:
        self._closing = True
        self.wake()
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        real_time(MESSAGE_PRIORITY)
        socket = self._context.socket(zmq.PUB)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.SNDHWM, 64)
        socket.bind(self._endpoint)
        shown = -1
        latest = time.monotonic() + self._longest
        while not self._closing:
            with self._news:
                self._news.wait_for(lambda: self._fresh, max(0.0, latest - time.monotonic()))
                self._fresh = False
            with self._servo.locked() as controller:  # numbered and asked in one breath: see Reply.seq
                self.seq += 1
                status, acks = controller.status(), controller.take_acks()
            newest, pictures = self._servo.newest, self._pictures
            message = observation(
                self.seq, pictures.stamp, newest.measured, status, acks, pictures.images, self._device()
            )
            socket.send(pack(message), zmq.NOBLOCK)
            if pictures.seq != shown:
                shown = pictures.seq
                self._picture_times.append(time.monotonic())
            latest = time.monotonic() + self._longest
        socket.close()
