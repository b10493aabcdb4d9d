"""The hw server on another machine: what it is (Station), and what its clock says beside ours (RobotClock).

Two machines' monotonic clocks differ by anything and drift apart. An exchange of four times (sent and heard here,
received and answered there; NTP's) gives the offset within half the round trip; that one is believed whose bound

    round trip / 2 + DRIFT · age

is least now. Every time stamp that crosses between the machines passes RobotClock.ours or .theirs, in far_app.link, and
nowhere else.
"""

from __future__ import annotations

import contextlib
import getpass
import os
import secrets
import socket
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import zmq
from zmq.utils.monitor import recv_monitor_message

from far_app.endpoints import Call, Endpoints
from far_app.errors import RobotError
from far_app.types import Ack, Observation, Target
from far_app.wire import WireError, pack, register, unpack

DRIFT = 2e-4
"""Seconds a second that two clocks may drift apart: twice the 100 ppm that crystals are sold with."""
FIRST, FIRST_EVERY, EVERY = 20, 0.01, 0.25
"""Exchanges at the start, and seconds between them then and later."""
KEPT = 240
"""Exchanges remembered: a minute."""
LIMIT = 0.025
"""Uncertainty of the offset, seconds, beyond which targets' expiry means nothing any more."""

_M = TypeVar("_M")


@register
@dataclass(frozen=True, kw_only=True)
class ClockQuery:
    sent: float
    """Monotonic seconds of who asks."""
    who: str = ""
    """An app that leads the arm or wants to (`myself`); nobody else."""
    leaving: bool = False
    """It leads no longer."""


@register
@dataclass(frozen=True, kw_only=True)
class ClockAnswer:
    sent: float
    """As asked."""
    received: float
    """Monotonic seconds of the hw server."""
    answered: float
    holder: str = ""
    """Who leads the arm; empty when nobody does."""


@register
@dataclass(frozen=True, kw_only=True)
class StationQuery:
    pass


@register
@dataclass(frozen=True, kw_only=True)
class Station:
    """What the hw server drives."""

    rig: Mapping[str, Any]
    """Its RigConfig as a dict."""
    task: str
    holder: str = ""
    """Which app leads its arm; empty when none does."""


def myself() -> str:
    """A name for this app that no other has: who and where, and after # what only tells it apart."""
    return f"{getpass.getuser()}@{socket.gethostname()[:64]}, process {os.getpid()}#{secrets.token_hex(8)}"


def spoken(who: str) -> str:
    """The part of such a name that a person reads."""
    return who.partition("#")[0]


@dataclass(frozen=True, kw_only=True)
class Exchange:
    offset: float
    """Their clock less ours."""
    round_trip: float
    at: float
    """Our time."""

    def bound(self, now: float) -> float:
        return self.round_trip / 2.0 + DRIFT * (now - self.at)


class RobotClock:
    """The hw server's clock beside ours. The same one until the first exchange."""

    def __init__(self) -> None:
        self._exchanges: deque[Exchange] = deque(maxlen=KEPT)
        self._best: Exchange | None = None

    def exchanged(self, answer: ClockAnswer, heard: float) -> None:
        """An answer came, at our time `heard`."""
        offset = ((answer.received - answer.sent) + (answer.answered - heard)) / 2.0
        round_trip = (heard - answer.sent) - (answer.answered - answer.received)
        self._exchanges.append(Exchange(offset=offset, round_trip=max(0.0, round_trip), at=heard))
        self._best = min(self._exchanges, key=lambda e: e.bound(heard))

    @property
    def exchanges(self) -> int:
        return len(self._exchanges)

    @property
    def offset(self) -> float:
        """Their clock less ours, seconds."""
        return 0.0 if self._best is None else self._best.offset

    @property
    def round_trip(self) -> float:
        """Of the exchange that is believed, seconds."""
        return 0.0 if self._best is None else self._best.round_trip

    def bound(self) -> float:
        """Seconds by which the offset may be wrong now."""
        return 0.0 if self._best is None else self._best.bound(time.monotonic())

    def ours(self, message: _M) -> _M:
        """A message from there in our time."""
        return shifted(message, -self.offset) if self._best is not None else message

    def theirs(self, message: _M) -> _M:
        """A message for there in their time."""
        return shifted(message, self.offset) if self._best is not None else message


def shifted(message: Any, by: float) -> Any:
    """The same message with each of its time stamps moved."""
    match message:
        case Observation():
            acks = tuple(shifted(ack, by) for ack in message.acks)
            return replace(message, stamp=message.stamp + by, acks=acks)
        case Ack():
            return replace(message, accepted=message.accepted + by, due=message.due + by)
        case Target():
            return replace(
                message, created=message.created + by, expires=message.expires + by, due=message.due + by
            )  # fmt: skip
        case Call():
            return replace(message, expires=message.expires + by)
    raise TypeError(f"a {type(message).__name__} has no place in another machine's time")


class ClockThread:
    """Keeps a RobotClock up until closed: some exchanges at once, then four a second. Each asks to lead the arm."""

    def __init__(self, context: zmq.Context[Any], endpoint: str, clock: RobotClock, who: str) -> None:
        self._context, self._endpoint, self._clock, self._who = context, endpoint, clock, who
        self.holder = ""
        """Who leads the arm, by the last answer."""
        self._closing = threading.Event()
        self.known = threading.Event()
        """Set once the first exchanges are done."""
        self._thread = threading.Thread(target=self._run, name="clock", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        line = asking(self._context, self._endpoint)
        while not self._closing.wait(EVERY if self.known.is_set() else FIRST_EVERY):
            with contextlib.suppress(zmq.Again):
                line.send(pack(ClockQuery(sent=time.monotonic(), who=self._who)), zmq.NOBLOCK)
            if line.poll(int(1000 * EVERY)):
                raw, heard = line.recv(), time.monotonic()
                answer = unpack(raw)
                if isinstance(answer, ClockAnswer):
                    self._clock.exchanged(answer, heard)
                    self.holder = answer.holder
                if self._clock.exchanges >= FIRST:
                    self.known.set()
        with contextlib.suppress(zmq.Again):
            line.send(pack(ClockQuery(sent=time.monotonic(), who=self._who, leaving=True)), zmq.NOBLOCK)
        line.close(linger=200)


def asking(context: zmq.Context[Any], endpoint: str) -> zmq.Socket[bytes]:
    """A REQ that may give up on an answer and ask again."""
    socket = context.socket(zmq.REQ)
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.REQ_RELAXED, 1)
    socket.setsockopt(zmq.REQ_CORRELATE, 1)
    socket.connect(endpoint)
    return socket


def station_at(endpoints: Endpoints, patience: float = 10.0) -> Station:
    """Who serves there. Raises RobotError, with what is known of why nobody answers."""
    context: zmq.Context[Any] = zmq.Context()
    endpoints.secure(context)
    socket = asking(context, endpoints.station)
    monitor = socket.get_monitor_socket()
    seen: set[int] = set()
    try:
        deadline = time.monotonic() + patience
        while time.monotonic() < deadline:
            with contextlib.suppress(zmq.Again):  # nobody there yet, or it has just closed the door
                socket.send(pack(StationQuery()), zmq.NOBLOCK)
            if socket.poll(500):
                answer = unpack(socket.recv())
                if isinstance(answer, Station):
                    return answer
            while monitor.poll(0):
                seen.add(recv_monitor_message(monitor)["event"])
    except WireError as error:
        raise RobotError(f"what answers at {endpoints.station} is not this program's hw server: {error}") from error
    finally:
        socket.disable_monitor()
        context.destroy(linger=0)
    raise RobotError(f"no hw server answered at {endpoints.station} within {patience:.0f} s: {_why(seen, endpoints)}")


def _why(seen: set[int], endpoints: Endpoints) -> str:
    event = zmq.Event
    refused = {event.HANDSHAKE_FAILED_AUTH, event.HANDSHAKE_FAILED_PROTOCOL, event.HANDSHAKE_FAILED_NO_DETAIL}
    if seen & refused or (event.CONNECTED in seen and event.HANDSHAKE_SUCCEEDED not in seen):
        what = "asks for keys" if endpoints.keys is None else "knows other keys: its server.key or this client's differ"
        return f"it refused this machine, for it {what}; copy what `far keys` made, and say --keys on both sides"
    if event.CONNECTED in seen:
        return "the connection stands, but the server hangs; see its own messages"
    return "nobody listens there; start `far hw-server` there first, and check the address, the cable and the firewall"
