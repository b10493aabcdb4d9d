"""Who has the page open, who of them answers, and who holds control.

Every connection is pinged by the page's server; the browser's own websocket answers, without the page's script. So a
browser that is frozen, asleep or cut off is noticed within a second; a page that is hidden, or whose script alone
hangs, is not.

One viewer holds control: who comes while nobody that answers holds it (so a reload keeps it), or who takes it. What
counts as somebody who looks is that viewer alone: nobody else could do more than STOP.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import itertools
import threading
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

EVERY = 0.25
"""Seconds between an answer and the next question."""
PRESENT = 1.0
"""Seconds without an answer from which a connection no longer counts."""

Handler = Callable[[ServerConnection], Awaitable[None]]


@dataclass(frozen=True, kw_only=True)
class Viewer:
    """One open page, as the others are told of it."""

    name: str
    """ "viewer 2", with its address unless that is this machine."""
    holds: bool
    answers: bool


class Presence:
    """Wraps the server's handler; everything else is for any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._heard: dict[ServerConnection, float] = {}
        self._names: dict[ServerConnection, str] = {}
        self._holder: ServerConnection | None = None
        self._numbers = itertools.count(1)

    def count(self) -> int:
        """1 while the viewer who holds control answers, else 0."""
        with self._lock:
            return int(self._holder is not None and self._answers(self._holder))

    def viewers(self) -> dict[ServerConnection, Viewer]:
        """All connections, in the order in which they came."""
        with self._lock:
            return {
                c: Viewer(name=name, holds=c is self._holder, answers=self._answers(c))
                for c, name in self._names.items()
            }

    def holder(self) -> Viewer | None:
        return next((viewer for viewer in self.viewers().values() if viewer.holds), None)

    def holds(self, connection: ServerConnection | None) -> bool:
        return connection is not None and connection is self._holder

    def take(self, connection: ServerConnection) -> None:
        """Control goes to this one, asked of nobody: a viewer must be able to help when the holder cannot."""
        with self._lock:
            if connection in self._names:
                self._holder = connection

    def around(self, handler: Handler) -> Handler:
        """The same handler, each of its connections asked whether it lives while it lasts."""

        async def watched(connection: ServerConnection) -> None:
            self._join(connection)
            asking = asyncio.create_task(self._ask(connection))
            try:
                await handler(connection)
            finally:
                asking.cancel()
                self._leave(connection)

        return watched

    def _join(self, connection: ServerConnection) -> None:
        with self._lock:
            self._heard[connection] = time.monotonic()
            self._names[connection] = _name(next(self._numbers), connection)
            if self._holder is None or not self._answers(self._holder):
                self._holder = connection

    def _leave(self, connection: ServerConnection) -> None:
        with self._lock:
            self._heard.pop(connection, None)
            self._names.pop(connection, None)
            if self._holder is connection:
                self._holder = None

    def _answers(self, connection: ServerConnection) -> bool:
        return time.monotonic() - self._heard.get(connection, -PRESENT) < PRESENT

    async def _ask(self, connection: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            while True:
                await (await connection.ping())
                self._heard[connection] = time.monotonic()
                await asyncio.sleep(EVERY)


def _name(number: int, connection: ServerConnection) -> str:
    address = str((connection.remote_address or ("",))[0])
    with contextlib.suppress(ValueError):
        if not ipaddress.ip_address(address).is_loopback:
            return f"viewer {number} at {address}"
    return f"viewer {number}"
