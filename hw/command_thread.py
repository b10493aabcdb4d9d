"""What the app tells the arm: targets and heartbeats (not replied), requests (replied), and the scene's geometry."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace

import zmq

from far_app.endpoints import Call, Endpoints, Reply
from far_app.errors import RobotError
from far_app.protocols import Guide, Heartbeat, Hold, Home, Reset, Resume
from far_app.scheduling import MESSAGE_PRIORITY, real_time
from far_app.station import ClockAnswer, ClockQuery, Station
from far_app.telemetry import GeometryRequest, SceneGeometry
from far_app.types import RobotMode, Target
from far_app.wire import WireError, pack, unpack
from hw.lease import Lease
from hw.picture_timing import PictureTiming
from hw.publisher_thread import PublisherThread
from hw.servo_thread import ServoThread

log = logging.getLogger(__name__)

PATIENCE_MS = 50
"""Longest wait for a message before looking whether to close."""
BUSY_MS = 2
"""The same while a scene reset is under way."""
EARLIEST = 0.02
"""Seconds that a target waits for its moment at most; one that claims to be earlier still is taken at once."""


class CommandThread:
    """Serves commands and geometry until closed."""

    def __init__(
        self, servo: ServoThread, publisher: PublisherThread, geometry: Callable[[], SceneGeometry | None],
        timing: PictureTiming, context: zmq.Context[zmq.Socket[bytes]], endpoints: Endpoints, station: Station,
    ) -> None:  # fmt: skip
        self._servo, self._publisher, self._geometry = servo, publisher, geometry
        self._timing, self._station = timing, station
        self._context, self._endpoints = context, endpoints
        self._lease = Lease()
        self._closing = False
        self._pending: list[tuple[Future[None], list[bytes]]] = []
        self._early: Target | None = None
        """Came before its moment, which it waits for."""
        self.damaged = 0
        """Messages that could not be read or do not belong here."""
        self._bound = threading.Event()
        self._thread = threading.Thread(target=self._run, name="commands", daemon=True)

    def start(self) -> None:
        self._thread.start()
        if not self._bound.wait(5.0):
            raise RobotError(f"cannot serve commands at {self._endpoints.commands}; is another hw server running?")

    def close(self) -> None:
        self._closing = True
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        real_time(MESSAGE_PRIORITY)
        self._commands = self._context.socket(zmq.ROUTER)
        self._commands.setsockopt(zmq.ROUTER_HANDOVER, 1)  # an app whose cable was cut comes back under its name
        geometry, station = self._context.socket(zmq.REP), self._context.socket(zmq.REP)
        at = self._endpoints
        poller = zmq.Poller()
        for socket, endpoint in ((self._commands, at.commands), (geometry, at.geometry), (station, at.station)):
            socket.setsockopt(zmq.LINGER, 0)
            socket.bind(endpoint)
            poller.register(socket, zmq.POLLIN)
        self._bound.set()
        while not self._closing:
            ready = dict(poller.poll(self._patience()))
            if self._commands in ready:
                self._serve(self._commands.recv_multipart())
            if station in ready:
                self._answer_station(station)
            if geometry in ready:
                self._answer_geometry(geometry)
            self._finish_resets()
            self._admit_in_time()
        for socket in (self._commands, geometry, station):
            socket.close()

    def _serve(self, parts: list[bytes]) -> None:
        try:
            message = unpack(parts[-1])
        except WireError as error:
            return self._damaged(f"{error}", parts)
        now = time.monotonic()
        refusal = self._lease.refusal(parts[0].decode(errors="replace").rpartition(" ")[0], now)
        if refusal and not (isinstance(message, Call) and isinstance(message.request, Hold)):
            if len(parts) == 3:
                return self._damaged(refusal, parts)
            self.damaged += 1
        elif len(parts) == 2 and isinstance(message, Target):
            self._take(message, now)
        elif len(parts) == 2 and isinstance(message, Call) and isinstance(message.request, Heartbeat):
            if now <= message.expires:
                with self._servo.locked() as controller:
                    controller.request(message.request, now)
        elif len(parts) == 3 and isinstance(message, Call):
            if now <= message.expires or isinstance(message.request, Hold):
                self._request(parts[:2], message.request)
            else:
                name, late = type(message.request).__name__, now - message.expires
                self._damaged(f"{name} came {late:.1f} s after its asker gave it up (a cut link?)", parts)
        else:
            self._damaged(f"a {type(message).__name__} in {len(parts) - 1} parts does not belong here", parts)

    def _patience(self) -> int:
        """Milliseconds, whole ones: the rest of a target's time is slept away."""
        longest = BUSY_MS if self._pending else PATIENCE_MS
        return longest if self._early is None else min(longest, max(0, int(1e3 * self._remaining(self._early))))

    @staticmethod
    def _remaining(target: Target) -> float:
        return target.due - time.monotonic()

    def _take(self, target: Target, now: float) -> None:
        """At its moment, so that the arm gets one target a tick however the app's work varies."""
        self._admit()
        self._early = target
        if not 0.0 < target.due - now <= EARLIEST:
            self._admit()
        lead = self._publisher.lead(min(target.due, now))
        if math.isfinite(target.due) and math.isfinite(lead):
            self._servo.shift_pictures(self._timing.shift(lead))

    def _admit_in_time(self) -> None:
        """The target that waits, if its moment comes within what a poll can tell."""
        if self._early is not None and (remaining := self._remaining(self._early)) < 1e-3:
            time.sleep(max(0.0, remaining))
            self._admit()

    def _admit(self) -> None:
        if self._early is not None:
            target, self._early = self._early, None
            with self._servo.locked() as controller:
                controller.offer(target, time.monotonic())
            self._publisher.wake()

    def _request(self, address: list[bytes], request: Home | Hold | Resume | Heartbeat | Reset | Guide) -> None:
        if not (isinstance(request, Hold) and request.latch):
            self._admit()  # it came first; a STOP outruns it, and it is refused
        if isinstance(request, Reset):
            self._pending.append((self._servo.reset(request.seed), address))
            return
        if isinstance(request, Resume) and self._latched():
            self._pending.append((self._servo.resume(), address))
            return
        if isinstance(request, Guide):
            self._pending.append((self._servo.guide(request), address))
            return
        if isinstance(request, Hold) and request.latch:
            self._servo.halt()
        try:
            with self._servo.locked() as controller:
                controller.request(request, time.monotonic())
        except RobotError as error:
            self._reply(address, str(error))
        else:
            self._reply(address)

    def _latched(self) -> bool:
        with self._servo.locked() as controller:
            return controller.status().mode is RobotMode.LATCHED

    def _finish_resets(self) -> None:
        for future, address in [p for p in self._pending if p[0].done()]:
            error = future.exception()
            self._reply(address, str(error) if error is not None else "")
        self._pending = [p for p in self._pending if not p[0].done()]

    def _reply(self, address: list[bytes], error: str = "") -> None:
        with self._servo.locked() as controller:
            reply = Reply(error=error, status=controller.status(), seq=self._publisher.seq)
        self._commands.send_multipart([*address, pack(reply)], zmq.NOBLOCK)
        self._publisher.wake()

    def _damaged(self, why: str, parts: list[bytes]) -> None:
        self.damaged += 1
        log.warning("refused a message: %s", why)
        if len(parts) == 3:
            self._reply(parts[:2], f"refused: {why}")

    def _answer_geometry(self, socket: zmq.Socket[bytes]) -> None:
        try:
            request = unpack(socket.recv())
        except WireError as error:
            log.warning("refused a geometry request: %s", error)
            request = None
        geometry = self._geometry()
        known = isinstance(request, GeometryRequest) and geometry is not None
        socket.send(pack(geometry) if known else b"", zmq.NOBLOCK)

    def _answer_station(self, socket: zmq.Socket[bytes]) -> None:
        received = time.monotonic()
        try:
            query = unpack(socket.recv())
        except WireError as error:
            log.warning("refused a question: %s", error)
            query = None
        if not isinstance(query, ClockQuery):
            socket.send(pack(replace(self._station, holder=self._lease.holder(received))), zmq.NOBLOCK)
            return
        if query.leaving:
            self._lease.leave(query.who)
        holder = self._lease.holder(received) if query.leaving else self._lease.ask(query.who, received)
        answer = ClockAnswer(sent=query.sent, received=received, answered=time.monotonic(), holder=holder)
        socket.send(pack(answer), zmq.NOBLOCK)
