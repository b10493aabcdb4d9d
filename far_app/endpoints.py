"""Where the processes of one run meet: ZeroMQ endpoints in a private folder (ipc), made by `far run`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from far_app.types import RobotStatus
from far_app.wire import register


@dataclass(frozen=True, kw_only=True)
class Endpoints:
    observations: str
    """hw server PUB: Observation (single part; subscribers conflate)."""
    commands: str
    """hw server ROUTER. One part: Target or Heartbeat, not replied (acks ride on observations). Two parts, a number of
    the client's choice and a request: replied with the same number and a Reply."""
    stop: str
    """hw server REP, served by its own thread: StopRequest → StopAck."""
    view: str
    """hw server PUB: View."""
    geometry: str
    """hw server REP: GeometryRequest → SceneGeometry."""
    telemetry: str
    """app PUB: Telemetry."""
    intents: str
    """app PULL: OperatorIntent."""

    @classmethod
    def in_folder(cls, folder: Path) -> Endpoints:
        """ipc endpoints below a folder; its path must leave room within the 107 bytes of a socket name."""
        names = ("observations", "commands", "stop", "view", "geometry", "telemetry", "intents")
        return cls(**{name: f"ipc://{folder}/{name}" for name in names})


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
