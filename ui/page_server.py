"""The viser server as we want it: bound where we said or not at all, loopback, own Origins only, no tunnel.

viser 1.1 binds 0.0.0.0 by default, moves to another port when its own is taken, accepts any Origin, opens a public
tunnel on a client's word, and lets a client's message write any field of a button's state. All of that is closed here.
"""

from __future__ import annotations

import contextlib
import io
import ipaddress
import logging
import math
import re
import socket
from collections.abc import Callable, Iterator
from typing import Any

import viser
import websockets.asyncio.server as websocket_server
from viser import _messages as messages

from far_app.errors import ConfigError
from ui.presence import Presence

MAX_MESSAGE = 2**18
"""Bytes a client may send at once; clicks and camera poses are far below."""


def open_page(host: str, port: int, presence: Presence) -> viser.ViserServer:
    """A running server on exactly this address, its connections watched by `presence`; give it Presses at once.

    Raises ConfigError when the address is not loopback or the port is taken."""
    listener = _listen(host, port)
    bound = int(listener.getsockname()[1])
    logging.getLogger("websockets.server").setLevel(logging.ERROR)
    with _serving(listener, bound, presence), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=bound, verbose=False)
    if server.get_port() != bound:
        server.stop()
        raise ConfigError(f"the page's server moved to port {server.get_port()} instead of {bound}; stop what holds it")
    return server


def page_url(host: str, port: int) -> str:
    return f"http://{f'[{host}]' if ':' in host else host}:{port}"


def _listen(host: str, port: int) -> socket.socket:
    address = "127.0.0.1" if host == "localhost" else host
    try:
        loopback = ipaddress.ip_address(address).is_loopback
    except ValueError:
        loopback = False
    if not loopback:
        raise ConfigError(
            f"--host is {host}: the page has no password, so it is served on loopback only (127.0.0.1 or ::1); "
            f"from another machine use: ssh -L {port}:127.0.0.1:{port} THIS_MACHINE"
        )
    listener = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((address, port))
        listener.listen(64)
    except OSError as error:
        listener.close()
        raise ConfigError(
            f"port {port} on {host} is not free ({error.strerror}): another program, perhaps another run, "
            f"listens there; stop it or choose another port with --port"
        ) from error
    return listener


def allowed_origins(port: int) -> list[re.Pattern[str] | None]:
    """Pages from this very port, by any of loopback's names; None is a client that is no browser."""
    return [re.compile(rf"https?://(localhost|127\.\d+\.\d+\.\d+|\[::1\]):{port}"), None]


@contextlib.contextmanager
def _serving(listener: socket.socket, port: int, presence: Presence) -> Iterator[None]:
    """While a ViserServer starts, its websocket server gets our socket, our Origins and our look at who is there."""
    original = websocket_server.serve

    def serve(handler: Any, host: Any = None, wanted: Any = None, **kwargs: Any) -> Any:
        kwargs.update(sock=listener, origins=allowed_origins(port), max_size=MAX_MESSAGE)
        return original(presence.around(handler), **kwargs)

    websocket_server.serve = serve  # type: ignore[assignment]
    try:
        yield
    finally:
        websocket_server.serve = original  # type: ignore[assignment]


class Presses:
    """What buttons and hotkeys do, by viser's ids; actions run on viser's event loop, so they must only enqueue.

    Goes past viser's own dispatch on purpose: that one needs a rendered 3D camera before a client may click, runs
    callbacks on a pool that can fill up, and writes whatever fields a client's message names.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._actions: dict[str, Callable[[], None]] = {}
        self._values: dict[str, tuple[viser.GuiSliderHandle[Any], Callable[[float], None]]] = {}
        wire = server._websock_server
        for kind in list(wire._incoming_handlers):
            wire.unregister_handler(kind)
        wire.register_handler(messages.GuiUpdateMessage, self._click)
        wire.register_handler(messages.CommandTriggerMessage, self._hotkey)

    def on(self, handle: viser.GuiButtonHandle | viser.CommandHandle, action: Callable[[], None]) -> None:
        self._actions[handle._impl.uuid] = action

    def on_value(self, handle: viser.GuiSliderHandle[Any], action: Callable[[float], None]) -> None:
        """A slider; the action gets a finite number within its limits, whatever the client says."""
        self._values[handle._impl.uuid] = (handle, action)

    def _click(self, _client: Any, message: messages.GuiUpdateMessage) -> None:
        slider = self._values.get(message.uuid)
        if slider is not None and set(message.updates) == {"value"}:
            value = message.updates["value"]
            if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
                handle, move = slider
                move(float(min(max(value, handle.min), handle.max)))
            return
        action = self._actions.get(message.uuid)
        if action is not None and message.updates == {"value": True}:
            action()

    def _hotkey(self, _client: Any, message: messages.CommandTriggerMessage) -> None:
        action = self._actions.get(message.uuid)
        if action is not None:
            action()
