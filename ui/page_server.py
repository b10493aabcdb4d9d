"""The viser server as we want it: bound where we said or not at all, behind ui/access.py, no tunnel.

viser 1.1 binds 0.0.0.0 by default, moves to another port when its own is taken, accepts any Origin, opens a public
tunnel on a client's word, and lets a client's message write any field of a button's state. All of that is closed here.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import logging
import math
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any

import viser
import websockets.asyncio.server as websocket_server
from viser import _messages as messages
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from far_app.errors import ConfigError
from ui.access import Access, Doors
from ui.presence import Presence

MAX_MESSAGE = 2**18
"""Bytes a client may send at once; clicks and camera poses are far below."""


def open_page(access: Access, port: int, presence: Presence, doors: Doors = lambda name: None) -> viser.ViserServer:
    """A running server on exactly this address, its connections watched by `presence`; give it Presses at once.
    `doors`: where its links /go/NAME lead.

    Raises ConfigError when the port is taken."""
    listener = access.listen(port)
    bound = int(listener.getsockname()[1])
    logging.getLogger("websockets.server").setLevel(logging.ERROR)
    with _serving(listener, bound, access, presence, doors), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=access.address, port=bound, verbose=False)
    if server.get_port() != bound:
        server.stop()
        raise ConfigError(f"the page's server moved to port {server.get_port()} instead of {bound}; stop what holds it")
    return server


@contextlib.contextmanager
def _serving(listener: socket.socket, port: int, access: Access, presence: Presence, doors: Doors) -> Iterator[None]:
    """While a ViserServer starts, its websocket server gets our socket, our rules and our look at who is there. Who
    comes before it is complete (a browser that lost the page before) waits: viser would fail on what it lacks yet."""
    original, complete = websocket_server.serve, threading.Event()

    def serve(handler: Any, host: Any = None, wanted: Any = None, *, process_request: Any, **kwargs: Any) -> Any:
        def answer(connection: ServerConnection, request: Request) -> Response | None:
            refused = access.respond(request, port, doors)
            return refused if refused is not None else process_request(connection, request)

        async def in_time(connection: ServerConnection) -> None:
            while not complete.is_set():
                await asyncio.sleep(0.01)
            await watched(connection)

        watched = presence.around(handler)
        kwargs.update(sock=listener, process_request=answer, max_size=MAX_MESSAGE)
        return original(in_time, **kwargs)

    websocket_server.serve = serve  # type: ignore[assignment]
    try:
        yield
    finally:
        websocket_server.serve = original  # type: ignore[assignment]
        complete.set()


class Presses:
    """What buttons and hotkeys do, by viser's ids; actions run on viser's event loop, so they must only enqueue.

    Goes past viser's own dispatch on purpose: that one needs a rendered 3D camera before a client may click, runs
    callbacks on a pool that can fill up, and writes whatever fields a client's message names. A press of a viewer who
    does not hold control is refused, but for what is everyone's.
    """

    def __init__(self, server: viser.ViserServer, presence: Presence) -> None:
        self._presence, self._wire = presence, server._websock_server
        self._actions: dict[str, tuple[Callable[[int], None], bool, str]] = {}
        self._values: dict[str, tuple[viser.GuiSliderHandle[Any], Callable[[float], None]]] = {}
        self._texts: dict[str, tuple[viser.GuiInputHandle[str], Callable[[str], None], int]] = {}
        self.refused: Callable[[str, str], None] = lambda what, why: None
        """Told of each press that was refused for want of control: its label, and why."""
        for kind in list(self._wire._incoming_handlers):
            self._wire.unregister_handler(kind)
        self._wire.register_handler(messages.GuiUpdateMessage, self._click)
        self._wire.register_handler(messages.CommandTriggerMessage, self._hotkey)

    def on(
        self, handle: viser.GuiButtonHandle | viser.CommandHandle, action: Callable[[], None], *, everyone: bool = False
    ) -> None:
        """`everyone`: also for those who only look."""
        self.on_viewer(handle, lambda _client: action(), everyone=everyone)

    def on_viewer(
        self, handle: viser.GuiButtonHandle | viser.CommandHandle, action: Callable[[int], None], *, everyone: bool
    ) -> None:
        """The action is told which client pressed."""
        self._actions[handle._impl.uuid] = (action, everyone, str(handle.label).split("\n")[0])

    def on_value(self, handle: viser.GuiSliderHandle[Any], action: Callable[[float], None]) -> None:
        """A slider; the action gets a finite number within its limits, whatever the client says."""
        self._values[handle._impl.uuid] = (handle, action)

    def on_text(self, handle: viser.GuiInputHandle[str], write: Callable[[str], None], limit: int) -> None:
        """A text field; `write` gets what it holds, in one line of at most `limit` characters."""
        self._texts[handle._impl.uuid] = (handle, write, limit)

    def _click(self, client: int, message: messages.GuiUpdateMessage) -> None:
        if message.uuid in self._values and set(message.updates) == {"value"}:
            self._slide(client, message.uuid, message.updates["value"])
        elif message.uuid in self._texts and set(message.updates) == {"value"}:
            self._type(client, message.uuid, message.updates["value"])
        elif message.updates == {"value": True}:
            self._act(client, message.uuid)

    def _hotkey(self, client: int, message: messages.CommandTriggerMessage) -> None:
        self._act(client, message.uuid)

    def _act(self, client: int, uuid: str) -> None:
        action, everyone, label = self._actions.get(uuid, (None, True, ""))
        if action is not None and self._may(client, everyone, label):
            action(client)

    def _slide(self, client: int, uuid: str, value: object) -> None:
        handle, move = self._values[uuid]
        number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if number and self._may(client, False, "a slider"):
            assert isinstance(value, int | float)
            move(float(min(max(value, handle.min), handle.max)))

    def _type(self, client: int, uuid: str, value: object) -> None:
        handle, write, limit = self._texts[uuid]
        if isinstance(value, str) and self._may(client, False, "a text field"):
            handle._impl.value = value  # as the browser shows it: emptying the field is a change then, and is sent
            write("".join(c if c.isprintable() else " " for c in value[:limit]))

    def _may(self, client: int, everyone: bool, label: str) -> bool:
        if everyone or self._presence.holds(self._wire._live_connections.get(client)):
            return True
        holder = self._presence.holder()
        self.refused(label, f"{holder.name if holder is not None else 'nobody'} holds control")
        return False
