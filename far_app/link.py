"""The robot behind sockets: far_app.protocols.Robot for an app whose arm lives in the hw server's process.

A thread reads every observation, keeps the newest and gathers the acknowledgments of all, so that a busy app misses
pictures but never an acknowledgment. Targets and requests go out on sockets of their own: a request that waits for its
reply never holds up a target. Times that come in or go out are translated here, and only here, where the hw server is
on another machine (far_app/station.py).
"""

from __future__ import annotations

import logging
import math
import threading
import time
from dataclasses import replace

import zmq

from far_app.endpoints import Call, Endpoints, Reply
from far_app.errors import ArmTaken, RobotError
from far_app.protocols import Guide, Heartbeat, Hold, Request, Reset, Resume
from far_app.scheduling import SERVING_PRIORITY, prompt_context, real_time
from far_app.station import LIMIT, ClockThread, RobotClock, myself, spoken
from far_app.types import Ack, Observation, Target
from far_app.wire import WireError, pack, unpack

log = logging.getLogger(__name__)

SILENCE = 1.0
"""Seconds without an observation after which the robot counts as lost."""
REQUEST_TIMEOUT = 1.0
RESET_TIMEOUT = 10.0
RESUME_TIMEOUT = 40.0
"""A real arm is connected anew, cleared and enabled by it."""
GUIDE_TIMEOUT = 5.0
"""A real arm changes its mode."""
LAST_CHANCE = 0.1
"""Seconds given to this process's own reading thread, which may have been starved too, before the robot is lost."""
HEARTBEAT_LIFE = 0.1
"""Seconds after which a heartbeat tells nothing any more: as long as a target is good for."""
WHAT_TO_DO = "see the hw server's log, then start again", "look at the cable and that machine, then press Resume"
"""About a silent hw server of ours, and one on another machine."""
POLL = 0.1
"""Seconds between looks at whether the link was closed."""


class RemoteRobot:
    """A Robot on the other side of a set of endpoints. observe() is for one thread; send() and request() for any."""

    def __init__(self, endpoints: Endpoints, connect_timeout: float = 30.0) -> None:
        """Waits for the first observation; raises RobotError when none comes within connect_timeout seconds."""
        self._context = prompt_context()
        endpoints.secure(self._context)
        self.endpoints = endpoints
        self.clock = RobotClock()
        self._who = myself()
        self._clock_thread: ClockThread | None = None
        self._targets = self._dealer("targets", send_limit=16)
        self._requests = self._dealer("requests", send_limit=16)
        self._targets_lock, self._requests_lock = threading.Lock(), threading.Lock()
        self._news = threading.Condition()
        self._newest: Observation | None = None
        self._acks: list[Ack] = []
        self._reply: Reply | None = None
        self._request_number = 0
        self._heard = time.monotonic()
        self._closed = False
        self.drops = 0
        """Observations published but never received."""
        self.unsent = 0
        """Targets and heartbeats that found the socket full (the hw server is gone or stuck)."""
        self.damaged = 0
        """Messages that could not be read."""
        self._thread = threading.Thread(target=self._receive, name="observations", daemon=True)
        try:
            if endpoints.elsewhere:
                self._clock_thread = ClockThread(self._context, endpoints.station, self.clock, self._who)
                self._compare_clocks(connect_timeout)
                self._lead()
            self._thread.start()
            with self._news:
                if not self._news.wait_for(lambda: self._newest is not None, connect_timeout):
                    raise RobotError(
                        f"no observation from the hw server at {endpoints.observations} within "
                        f"{connect_timeout:.0f} s; see its own log for why"
                    )
        except RobotError:
            self._let_go()
            raise

    @property
    def on_the_way(self) -> float:
        """far_app.protocols.Distant: half the round trip to another machine."""
        return self.clock.round_trip / 2

    def _compare_clocks(self, patience: float) -> None:
        assert self._clock_thread is not None, "two machines have a clock thread"
        if not self._clock_thread.known.wait(patience):
            raise RobotError(
                f"the clock of the hw server at {self.endpoints.station} did not answer within {patience:.0f} s; is it "
                "running, and is the link up?"
            )
        self._check_clock()

    def _lead(self) -> None:
        """One app leads an arm: raise ArmTaken where another does (a hw server of our own serves nobody else)."""
        if self._clock_thread is not None and (holder := self._clock_thread.holder) not in ("", self._who):
            raise ArmTaken(
                f"the hw server at {self.endpoints.station} serves {spoken(holder)}; end that run first: two would "
                "fight over one arm"
            )

    def _check_clock(self) -> None:
        """Targets expire by the hw server's clock: it must be known well enough."""
        bound = self.clock.bound()
        if bound > LIMIT:
            raise RobotError(
                f"the hw server's clock is known to ±{1e3 * bound:.0f} ms only (limit {1e3 * LIMIT:.0f} ms, best round "
                f"trip {1e3 * self.clock.round_trip:.0f} ms): the link is too slow or was silent for long; use a cable "
                "of its own"
            )

    def _dealer(self, what: str, send_limit: int) -> zmq.Socket[bytes]:
        socket = self._context.socket(zmq.DEALER)
        if self.endpoints.elsewhere:
            socket.setsockopt(zmq.IDENTITY, f"{self._who} {what}".encode())
        socket.setsockopt(zmq.SNDHWM, send_limit)
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(self.endpoints.commands)
        return socket

    # ── observations ──

    def _receive(self) -> None:
        real_time(SERVING_PRIORITY)
        socket = self._context.socket(zmq.SUB)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RCVHWM, 256)
        socket.subscribe(b"")
        socket.connect(self.endpoints.observations)
        while not self._closed:
            if not socket.poll(int(1000 * POLL)):
                continue
            raw = socket.recv()
            try:
                observation = unpack(raw)
            except WireError as error:
                observation = error
            if isinstance(observation, Observation):
                self._take(observation)
            else:
                self.damaged += 1
                log.warning("not an observation: %s", observation)
        socket.close()

    def _take(self, observation: Observation) -> None:
        with self._news:
            if self._newest is not None:
                self.drops += max(0, observation.seq - self._newest.seq - 1)
            self._newest = observation = self.clock.ours(observation)
            self._acks.extend(observation.acks)
            self._heard = time.monotonic()
            self._news.notify_all()

    def observe(self) -> Observation:
        """The newest; each acknowledgment is handed out once."""
        with self._news:
            if not self._closed and self.silence() > SILENCE:
                self._news.wait(LAST_CHANCE)
            newest, reply = self._newest, self._reply
            silence = self.silence()
            if self._closed or newest is None or silence > SILENCE:
                raise RobotError(
                    f"no observation from the hw server for {silence:.1f} s (limit {SILENCE} s): it died, hangs or "
                    f"was cut off; the arm holds by its watchdog; {WHAT_TO_DO[self.endpoints.elsewhere]}"
                )
            self._check_clock()
            self._lead()
            acks, self._acks = tuple(self._acks), []
        newest = replace(newest, acks=acks)
        if reply is not None and newest.seq <= reply.seq:
            return replace(newest, status=reply.status)
        return newest

    def age(self) -> float:
        """Seconds since the newest observation's pictures were captured; inf before the first."""
        newest = self._newest
        return math.inf if newest is None else time.monotonic() - newest.stamp

    def silence(self) -> float:
        """Seconds since anything at all came from the hw server."""
        return time.monotonic() - self._heard

    # ── commands ──

    def send(self, target: Target) -> None:
        self._tell(target)

    def request(self, request: Request) -> None:
        if isinstance(request, Heartbeat):
            self._tell(Call(request=request, expires=time.monotonic() + HEARTBEAT_LIFE))
            return
        limit = {Reset: RESET_TIMEOUT, Resume: RESUME_TIMEOUT, Guide: GUIDE_TIMEOUT}.get(type(request), REQUEST_TIMEOUT)
        reply = self._ask(request, limit)
        if reply.error:
            raise RobotError(reply.error)
        with self._news:
            self._reply = reply
            self._heard = time.monotonic()  # it answered: a reset that kept it busy is no silence

    def _tell(self, message: Target | Call) -> None:
        with self._targets_lock:
            if self._closed:
                raise RobotError("this link to the hw server was closed; make another")
            try:
                self._targets.send(pack(self.clock.theirs(message)), zmq.NOBLOCK)
            except zmq.Again:
                self.unsent += 1

    def _ask(self, request: Request, limit: float) -> Reply:
        name = type(request).__name__
        with self._requests_lock:
            if self._closed:
                raise RobotError("this link to the hw server was closed; make another")
            self._request_number += 1
            number = str(self._request_number).encode()
            began = time.monotonic()
            try:
                call = self.clock.theirs(Call(request=request, expires=began + limit))
                self._requests.send_multipart([number, pack(call)], zmq.NOBLOCK)
                while (waited := time.monotonic() - began) < limit:
                    if isinstance(request, Resume) and min(waited, self.silence()) > REQUEST_TIMEOUT:
                        limit = REQUEST_TIMEOUT  # an arm that is made ready takes its time, but its server is heard
                        break
                    if not self._requests.poll(int(1000 * min(POLL, limit - waited))):
                        continue
                    answered, raw = self._requests.recv_multipart()
                    if answered == number:  # else the late answer to a request that was given up
                        reply = unpack(raw)
                        assert isinstance(reply, Reply), f"a {type(reply).__name__} in place of a Reply"
                        return reply
            except zmq.Again:
                pass
        raise RobotError(
            f"the hw server did not answer {name} within {limit:.0f} s; it may hang or be gone: see its log, and use "
            "the physical emergency stop where there is one"
        )

    def close(self) -> None:
        if self._closed:
            return
        try:
            if self.silence() < SILENCE:
                self.request(Hold(reason="the app let go of the arm"))
        except RobotError as error:
            log.warning("letting go: %s", error)
        self._let_go()

    def _let_go(self) -> None:
        with self._targets_lock, self._requests_lock:
            self._closed = True
            self._targets.close()
            self._requests.close()
        if self._clock_thread is not None:
            self._clock_thread.close()
        if self._thread.ident is not None:
            self._thread.join(timeout=2.0)
        self._context.destroy(linger=0)
