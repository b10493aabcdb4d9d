"""How many browsers have the page open and answer: a connection alone does not tell, a frozen machine keeps it.

Every connection is pinged by the page's server; the browser's own websocket answers, without the page's script. So a
browser that is frozen, asleep or cut off is noticed within a second; a page that is hidden, or whose script alone
hangs, is not.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

EVERY = 0.25
"""Seconds between an answer and the next question."""
PRESENT = 1.0
"""Seconds without an answer from which a connection no longer counts."""

Handler = Callable[[ServerConnection], Awaitable[None]]


class Presence:
    """Wraps the server's handler; count() is for any thread."""

    def __init__(self) -> None:
        self._heard: dict[ServerConnection, float] = {}

    def count(self) -> int:
        """Connections that answered lately."""
        now = time.monotonic()
        return sum(now - heard < PRESENT for heard in tuple(self._heard.values()))

    def around(self, handler: Handler) -> Handler:
        """The same handler, each of its connections asked whether it lives while it lasts."""

        async def watched(connection: ServerConnection) -> None:
            self._heard[connection] = time.monotonic()
            asking = asyncio.create_task(self._ask(connection))
            try:
                await handler(connection)
            finally:
                asking.cancel()
                self._heard.pop(connection, None)

        return watched

    async def _ask(self, connection: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            while True:
                await (await connection.ping())
                self._heard[connection] = time.monotonic()
                await asyncio.sleep(EVERY)
