"""The servo thread: the only one that touches the plant. Absolute deadlines; after a late tick it re-anchors.

Everything else talks to it through `locked` (the controller, for a moment), `newest` (what it last measured) and `call`
(something to run between two ticks: a scene reset).
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from far_app.errors import FarError, RobotError
from far_app.protocols import Guide, Resume
from far_app.scheduling import SERVO_NICENESS, SERVO_PRIORITY, real_time
from far_app.types import RobotMode
from hw.cameras import Moment
from hw.controller import ArmController
from hw.plant import Measured, Plant

log = logging.getLogger(__name__)

RE_ANCHOR = 0.5
"""Lateness, as a share of a servo period, from which the schedule starts anew instead of catching up."""
YIELD = 0.0005
"""Seconds given to others at each re-anchoring: a plant too slow for its rate must not take a core for itself."""


@dataclass(frozen=True, kw_only=True)
class Newest:
    """What the servo thread last knew."""

    measured: Measured
    stamp: float
    moment: Moment
    """The newest snapshot for the cameras."""


class ServoThread:
    """Runs a controller on a plant at plant.servo_hz."""

    def __init__(self, plant: Plant, controller: ArmController, camera_rate: float) -> None:
        self._plant, self._controller = plant, controller
        self._lock = threading.Lock()
        self._calls: queue.SimpleQueue[tuple[Callable[[], None], Future[None]]] = queue.SimpleQueue()
        self._per_picture = max(1, round(plant.servo_hz / camera_rate))
        self._next_picture = 1
        self._closing = False
        self._snapped = threading.Condition()
        now = time.monotonic()
        first = Moment(snapshot=plant.snapshot(), stamp=now, seq=0)
        self.newest = Newest(measured=controller.measured, stamp=now, moment=first)
        self.scheduling = ""
        """How the thread is scheduled: "fifo", "nice" or "normal"."""
        self.ticks = self.re_anchored = 0
        self.lateness = np.zeros(1 << 14)
        """Seconds late, of the last 16384 ticks, as a ring."""
        self._thread = threading.Thread(target=self._run, name="servo", daemon=True)

    def start(self) -> None:
        self._thread.start()

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    @contextmanager
    def locked(self) -> Iterator[ArmController]:
        """The controller, for as short as possible."""
        with self._lock:
            yield self._controller

    def stop(self, reason: str) -> None:
        """Stop the arm by its fastest path now and latch at the next servo tick, whoever holds the lock."""
        self._plant.halt()
        self._controller.stop(reason)

    def halt(self) -> None:
        """Stop the arm by its fastest path now."""
        self._plant.halt()

    def call(self, work: Callable[[], None]) -> Future[None]:
        """Run this in the servo thread, between two ticks."""
        future: Future[None] = Future()
        self._calls.put((work, future))
        return future

    def reset(self, seed: int) -> Future[None]:
        """Scene and arm as the seed says."""

        def work() -> None:
            self._controller.refuse_latched("Reset")
            self._plant.reset(seed)
            with self._lock:
                self._controller.reset(self._plant.measure(), seed)

        return self.call(work)

    def resume(self) -> Future[None]:
        """Leave the latch: the arm is made ready first, in the servo thread (nothing moves while it is latched)."""

        def work() -> None:
            with self._lock:
                self._controller.refuse_unlatching()
            stands = self._plant.rearm()
            measured = self._plant.measure()
            with self._lock:
                self._controller.measured = measured
                if stands:
                    self._controller.stand()
                self._controller.request(Resume(), time.monotonic())

        return self.call(work)

    def guide(self, request: Guide) -> Future[None]:
        """Make the arm compliant for a person's hands, or tell its gripper meanwhile; off holds it where it is, and it
        is made stiff before the next command."""

        def work() -> None:
            with self._lock:
                self._controller.refuse_guiding(request)
            if request.on and not self._plant.guided:
                self._plant.guide(True)
            measured = self._plant.measure()
            with self._lock:
                self._controller.measured = measured
                self._controller.request(request, time.monotonic())

        return self.call(work)

    def shift_pictures(self, ticks: int) -> None:
        """Take the next snapshot so many servo ticks later or earlier, and all after it at the usual distance."""
        self._next_picture += ticks

    def wait_for_moment(self, after: int, timeout: float) -> Moment | None:
        """The newest snapshot, once there is one later than that number."""
        with self._snapped:
            if self._snapped.wait_for(lambda: self.newest.moment.seq > after, timeout):
                return self.newest.moment
        return None

    def report(self) -> str:
        """How well it kept time, for the log."""
        late = 1e3 * np.percentile(self.lateness[: max(1, self.ticks)], (50, 99, 100))
        return (
            f"servo: {self.ticks} ticks, late ms p50 {late[0]:.2f}, p99 {late[1]:.2f}, max {late[2]:.2f}; "
            f"re-anchored {self.re_anchored}, scheduling {self.scheduling}"
        )

    def close(self) -> None:
        self._closing = True
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        self.scheduling = real_time(SERVO_PRIORITY, SERVO_NICENESS)
        log.info("servo thread at %d Hz, scheduling %s", self._plant.servo_hz, self.scheduling)
        try:
            self._loop(1.0 / self._plant.servo_hz)
        except Exception as error:  # whatever the plant raises, the operator must read it
            log.exception("the servo thread ended")
            with self._lock:
                self._controller.fail(f"the servo loop ended ({type(error).__name__}: {error}); restart the program")

    def _loop(self, period: float) -> None:
        deadline = time.monotonic() + period
        while not self._closing:
            now = time.monotonic()
            if now < deadline:
                time.sleep(deadline - now)
                now = time.monotonic()
            self.lateness[self.ticks % len(self.lateness)] = now - deadline
            self.ticks += 1
            if now - deadline > RE_ANCHOR * period:
                self.re_anchored += 1
                time.sleep(YIELD)
                deadline = now = time.monotonic()
            deadline += period
            self._tick(now)
            if not self._calls.empty():
                self._answer_calls()
                deadline = time.monotonic() + period

    def _tick(self, now: float) -> None:
        measured = self._plant.measure()
        with self._lock:
            pose, gripper = self._controller.tick(now, measured)
            led = self._controller.mode is RobotMode.GUIDED
        if self._plant.guided and not led:
            self._stiffen()
        self._plant.servo(pose, gripper)
        self._plant.advance()
        moment, snap = self.newest.moment, self.ticks >= self._next_picture
        if snap:
            moment = Moment(snapshot=self._plant.snapshot(), stamp=time.monotonic(), seq=moment.seq + 1)
        self.newest = Newest(measured=self._plant.measure(), stamp=time.monotonic(), moment=moment)
        if snap:
            self._next_picture = self.ticks + self._per_picture
            with self._snapped:
                self._snapped.notify_all()

    def _stiffen(self) -> None:
        """The arm is no longer led by hand: it is commanded again, from where it stands."""
        try:
            self._plant.guide(False)
        except RobotError as error:
            with self._lock:
                self._controller.fail(f"the arm could not be made stiff again: {error}")

    def _answer_calls(self) -> None:
        while not self._calls.empty():
            work, future = self._calls.get()
            try:
                work()
            except FarError as error:
                future.set_exception(error)
            else:
                future.set_result(None)
