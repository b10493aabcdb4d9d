"""Where an hw server is reached: a folder of sockets for an app on this machine, ports for one on another."""

from __future__ import annotations

from pathlib import Path

import zmq

from far_app.endpoints import HARDWARE, Endpoints
from far_app.errors import ConfigError
from far_app.keys import server_keys

SOCKET_NAME = 107
"""Bytes the operating system allows in a socket's name."""


def in_folder(folder: Path) -> Endpoints:
    """Endpoints for an app on this machine; the folder is made. Raises ConfigError."""
    longest = len(str(folder / "observations").encode())
    if longest > SOCKET_NAME:
        raise ConfigError(
            f"sockets below {folder} need names of {longest} bytes, at most {SOCKET_NAME} fit; choose a shorter folder"
        )
    folder.mkdir(parents=True, exist_ok=True)
    return Endpoints.in_folder(folder)


def to_machines(address: str, keys: Path | None) -> Endpoints:
    """Endpoints for an app on another machine. Raises ConfigError, also where a port is taken."""
    endpoints = Endpoints.at(address, server_keys(keys) if keys is not None else None)
    with zmq.Context() as context, context.socket(zmq.PAIR) as socket:
        for name in HARDWARE:
            endpoint = getattr(endpoints, name)
            try:
                socket.bind(endpoint)
            except zmq.ZMQError as error:
                raise ConfigError(
                    f"cannot serve {name} at {endpoint}: {error}; {len(HARDWARE)} ports from {address} on must be "
                    "free, and the address one of this machine's: is another hw server running?"
                ) from error
    return endpoints
