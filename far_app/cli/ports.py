"""The page's port: asked for before anything starts, so that a busy one is one clear error."""

from __future__ import annotations

import contextlib
import socket

from far_app.errors import ConfigError


def choose_port(host: str, port: int) -> int:
    """The port itself when it is free, a free one for 0; ConfigError when it is taken or not ours to take."""
    if not 0 <= port <= 65535:
        raise ConfigError(f"port is {port}, must be 0 (any free one) to 65535")
    with contextlib.closing(socket.socket()) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise ConfigError(
                f"port {port} on {host} cannot be used ({error.strerror}); end what uses it or give another --port"
            ) from error
        return probe.getsockname()[1]


def answers(host: str, port: int) -> bool:
    """Whether somebody listens there."""
    try:
        with socket.create_connection((host, port), timeout=0.2):
            return True
    except OSError:
        return False
