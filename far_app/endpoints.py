"""Where the processes of one run meet: ZeroMQ endpoints in a private folder (ipc), made by `far run`; the hw server's
on another machine (tcp, CURVE) where `far run --hw` says so.
"""

from __future__ import annotations

import ipaddress
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import zmq

from far_app.errors import ConfigError
from far_app.keys import ClientKeys, Gate, ServerKeys, client_keys
from far_app.protocols import Guide, Heartbeat, Hold, Home, Reset, Resume
from far_app.types import RobotStatus
from far_app.wire import register

HARDWARE = ("observations", "commands", "stop", "view", "geometry", "station")
"""The hw server's, in the order of their ports."""
APP = ("telemetry", "intents")
ELSEWHERE = "hw.json"
"""In the run's folder: where the hw server is, when not there."""
PING_MS, LOST_MS = 200, 1000
"""Between signs of life of a connection, and the silence after which it is made anew."""


@dataclass(frozen=True, kw_only=True)
class Endpoints:
    observations: str
    """hw server PUB: Observation (single part; subscribers conflate)."""
    commands: str
    """hw server ROUTER. One part: Target or Call of a Heartbeat, not replied (acks ride on observations). Two parts, a
    number of the client's choice and a Call: replied with the same number and a Reply."""
    stop: str
    """hw server REP, served by its own thread: StopRequest → StopAck."""
    view: str
    """hw server PUB: View."""
    geometry: str
    """hw server REP: GeometryRequest → SceneGeometry."""
    station: str
    """hw server REP: StationQuery → Station, ClockQuery → ClockAnswer."""
    telemetry: str
    """app PUB: Telemetry."""
    intents: str
    """app PULL: OperatorIntent."""
    elsewhere: bool = False
    """The hw server may be on another machine: its clock is not ours."""
    keys: ServerKeys | ClientKeys | None = None
    """For the hw server's endpoints."""

    @classmethod
    def in_folder(cls, folder: Path) -> Endpoints:
        """ipc endpoints below a folder; its path must leave room within the 107 bytes of a socket name. The hw server's
        are elsewhere if a file in it says so."""
        names: dict[str, Any] = {name: f"ipc://{folder}/{name}" for name in (*HARDWARE, *APP)}
        here = cls(**names)
        note = folder / ELSEWHERE
        if not note.exists():
            return here
        told = json.loads(note.read_text())
        keys = client_keys(Path(told["keys"])) if told["keys"] else None
        return replace(cls.at(told["address"], keys), telemetry=here.telemetry, intents=here.intents)

    @classmethod
    def at(cls, address: str, keys: ServerKeys | ClientKeys | None) -> Endpoints:
        """The hw server's at tcp://HOST:PORT and the ports after it. Raises ConfigError, also where keys are needed."""
        host, port = split(address)
        if keys is None and not loopback(host):
            raise ConfigError(
                f"{address} can be reached from other machines, and without keys anybody there could move the arm: "
                "make keys with `far keys --out FOLDER`, copy them to both machines, and say --keys FOLDER on both"
            )
        names: dict[str, Any] = dict.fromkeys(APP, "") | {
            name: f"tcp://{host}:{port + i}" for i, name in enumerate(HARDWARE)
        }
        return replace(cls(**names), elsewhere=True, keys=keys)

    def secure(self, context: zmq.Context[Any]) -> Gate | None:
        """Prepare a context for sockets to (or of) the hw server, before it makes any; the server's doorkeeper."""
        if not self.elsewhere:
            return None
        context.setsockopt(zmq.HEARTBEAT_IVL, PING_MS)
        context.setsockopt(zmq.HEARTBEAT_TIMEOUT, LOST_MS)
        context.setsockopt(zmq.HEARTBEAT_TTL, LOST_MS)
        context.setsockopt(zmq.CONNECT_TIMEOUT, LOST_MS)
        if self.keys is None:
            return None
        gate = Gate(context, self.keys.admitted) if isinstance(self.keys, ServerKeys) else None
        self.keys.secure(context)
        return gate


def note_elsewhere(folder: Path, address: str, keys: Path | None) -> None:
    """Tell all processes of a run that the hw server is at an address."""
    (folder / ELSEWHERE).write_text(json.dumps({"address": address, "keys": str(keys.absolute()) if keys else ""}))


def split(address: str) -> tuple[str, int]:
    """Host and port of tcp://HOST:PORT. Raises ConfigError."""
    scheme, _, rest = address.partition("://")
    host, _, port = rest.rpartition(":")
    if scheme != "tcp" or not host or ":" in host or not port.isdigit() or not 0 < int(port) <= 65535 - len(HARDWARE):
        raise ConfigError(
            f"'{address}' is not tcp://HOST:PORT (an IPv4 address or a name, and the first of {len(HARDWARE)} ports), "
            "as in tcp://192.168.1.20:5600"
        )
    return host, int(port)


def loopback(host: str) -> bool:
    """Only this machine can be meant."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@register
@dataclass(frozen=True, kw_only=True)
class Call:
    """A request on its way to the hw server."""

    request: Home | Hold | Resume | Heartbeat | Reset | Guide
    expires: float
    """Monotonic seconds of the hw server; read later than this it must not act any more: it lay in a cut cable while
    the operator was told that it failed."""


@register
@dataclass(frozen=True, kw_only=True)
class Reply:
    """The hw server's answer to a request."""

    error: str = ""
    """Why it was refused or failed; empty when accepted."""
    status: RobotStatus
    """Right after the request."""
    seq: int
    """The newest Observation published by then; its status is older than this one."""
