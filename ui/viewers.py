"""What one viewer alone sees: controls that only the holder of control may use, who that is, the open list of keys.

viser shares its widgets among all clients. So a widget that looks different to each is made once, shared and disabled,
and its state is sent to each client by itself. The two streams have no common order and a client's first update may
come before the widget it is for: everything is sent again every AGAIN seconds.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import viser
from viser import _messages as messages
from viser.infra import WebsockClientConnection

from ui import html
from ui.keys import HELP, Page, add_hotkey, hint, key_of
from ui.page_server import Presses
from ui.presence import Presence, Viewer

AGAIN = 2.0
"""Seconds."""
_BARE = (17, 24, 32)

Widget = viser.GuiButtonHandle | viser.GuiHtmlHandle | viser.CommandHandle


@dataclass(frozen=True, kw_only=True)
class Live:
    """A control as it is now."""

    button: viser.GuiButtonHandle
    hotkey: viser.CommandHandle | None
    enabled: bool
    label: str
    line: str
    """Below its label: its key, what it does, or why it cannot act."""


class Viewers:
    """Buttons "Take control" and "keys", and whatever else differs from viewer to viewer; `show` from one thread."""

    def __init__(self, server: viser.ViserServer, presses: Presses, presence: Presence, page: Page) -> None:
        self._wire, self._presence, self._page = server._websock_server, presence, page
        self._sent: dict[int, dict[str, object]] = {}
        self._forget = 0.0
        self._listing: set[int] = set()
        """Clients that have the list of keys open."""
        gui = server.gui
        gui.add_html('<div class="far-seat slot-seat"></div>')
        self._seat = gui.add_button("Take control", disabled=True, color=_BARE)
        gui.add_html('<div class="far-seat slot-keys"></div>')
        keys = gui.add_button(f"Keys\n{hint(page, HELP)}", color=_BARE)
        key = key_of(page, HELP)
        assert key is not None
        self._list = gui.add_html(html.keys(page, False))
        presses.on_viewer(self._seat, self._take, everyone=True)
        presses.on_viewer(keys, self._toggle, everyone=True)
        for typed in (key, replace(key, modifier=None)):  # some keyboards have ? without Shift
            presses.on_viewer(add_hotkey(gui, typed, "Keys"), self._toggle, everyone=True)

    def _take(self, client: int) -> None:
        connection = self._wire._live_connections.get(client)
        if connection is not None:
            self._presence.take(connection)

    def _toggle(self, client: int) -> None:
        self._listing ^= {client}

    def show(self, controls: Iterable[Live]) -> None:
        """Every control as it is for the holder of control; disabled with the reason for everyone else."""
        now = time.monotonic()
        if now > self._forget:
            self._sent, self._forget = {}, now + AGAIN
        here = self._here()
        self._listing &= set(here)
        holder = next((v for v in here.values() if v.holds), None)
        for client, viewer in here.items():
            label, line, may = seat(viewer, holder, len(here))
            self._send(client, self._seat, disabled=not may, label=f"{label}\n{line}")
            self._send(client, self._list, content=html.keys(self._page, client in self._listing))
            for control in controls:
                disabled = not (control.enabled and viewer.holds)
                says = control.line if viewer.holds else "take control first"
                self._send(client, control.button, disabled=disabled, label=f"{control.label}\n{says}")
                if control.hotkey is not None:
                    self._send(client, control.hotkey, disabled=disabled)

    def _here(self) -> dict[int, Viewer]:
        viewers = self._presence.viewers()
        return {client: viewers[c] for client, c in tuple(self._wire._live_connections.items()) if c in viewers}

    def _send(self, client: int, widget: Widget, **properties: Any) -> None:
        """What is new to this client of a widget's properties."""
        state = self._wire._client_state_from_id.get(client)
        known = self._sent.setdefault(client, {})
        uuid = widget._impl.uuid
        news = {name: value for name, value in properties.items() if known.get(f"{uuid} {name}") != value}
        if state is None or not news:
            return
        known.update({f"{uuid} {name}": value for name, value in news.items()})
        kind = messages.CommandUpdateMessage if isinstance(widget, viser.CommandHandle) else messages.GuiUpdateMessage
        WebsockClientConnection(client, state).queue_message(kind(uuid, news))


def seat(viewer: Viewer, holder: Viewer | None, count: int) -> tuple[str, str, bool]:
    """The button of control for this viewer: label, line below, whether it can be pressed."""
    others = count - 1
    if viewer.holds:
        return "You have control", f"{others} more watching" if others else "nobody else watches", False
    if holder is None:
        return "Take control", "nobody has it", True
    return "Take control", f"{holder.name} has it" if holder.answers else f"{holder.name} does not answer", True
