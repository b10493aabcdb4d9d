"""Panels over the 3D view that open at their tab: steering by hand, marks, policy versions. One small file each.

A panel is data (Item: what a button says, why it cannot act now, what it asks of the app) and one piece of HTML. The
tabs are the browser's own <details>: opening one costs the server nothing, and each viewer opens his own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import viser

from far_app.session_states import State
from far_app.telemetry import Telemetry
from ui.keys import Page, add_hotkey, hint, key_of
from ui.page_server import Presses
from ui.view_model import Freshness
from ui.viewers import Live

Box = tuple[float, float, float, float]
"""Left, top, width, height in page units, within the panel."""
QUIET, GREEN, AMBER, BLUE = (36, 50, 65), (31, 122, 77), (140, 92, 16), (22, 92, 140)


@dataclass(frozen=True, kw_only=True)
class Item:
    """One button."""

    label: str
    box: Box
    reason: Callable[[Telemetry], str]
    """Why it cannot act now; empty when it can."""
    asks: Callable[[Telemetry], Any]
    """What it says to the app; None for what only the page does."""
    action: str = ""
    """Its key's, in ui/keys.py."""
    color: tuple[int, int, int] = QUIET


class Panel(Protocol):
    """What ui/console.py knows of each."""

    name: str
    """Of its tab and its marks in style.css."""
    title: str
    height: float
    """Page units."""

    @property
    def items(self) -> Sequence[Item]:
        """Its buttons."""
        ...

    def html(self, telemetry: Telemetry | None) -> str:
        """Its words, above and between the buttons."""
        ...


def withheld(telemetry: Telemetry | None, fresh: Freshness) -> str:
    """Why nothing at all can be asked of the app now."""
    if telemetry is None:
        return "waiting for the app"
    if fresh.app_silent:
        return "the app is silent"
    return "the session is over" if telemetry.state is State.FINISHED else ""


class Panels:
    """Their tabs and buttons in a page. `live` and `show` from one thread; presses only enqueue."""

    def __init__(
        self,
        gui: viser.GuiApi,
        presses: Presses,
        latest: Callable[[], tuple[Telemetry | None, Freshness]],
        say: Callable[[Any], None],
        refuse: Callable[[str, str], None],
        panels: Sequence[Panel],
    ) -> None:
        """`say` hands a word on to the app, `refuse` tells the viewer why a press had no effect."""
        self._latest, self._say, self._refuse = latest, say, refuse
        self._panels, self._gui = panels, gui
        tabs = "".join(f'<details name="far-tab" id="far-tab-{p.name}"><summary>{p.title}</summary></details>'
                       for p in panels)  # fmt: skip
        gui.add_html(f'<div class="far-tabs">{tabs}</div>')
        self._words = [(panel, gui.add_html(_frame(panel, None))) for panel in panels]
        self._buttons: list[tuple[Item, viser.GuiButtonHandle, viser.CommandHandle | None]] = []
        self._places: list[str] = []
        for panel in panels:
            self._places.append(_frame_place(panel))
            for item in panel.items:
                self._add(panel, item, presses)

    def _add(self, panel: Panel, item: Item, presses: Presses) -> None:
        handle = self._gui.add_button(item.label, disabled=True, color=item.color)
        presses.on(handle, lambda: self._press(item))
        key = key_of(Page.CONSOLE, item.action) if item.action else None
        hotkey = add_hotkey(self._gui, key, item.label, disabled=True) if key is not None else None
        if hotkey is not None:
            presses.on(hotkey, lambda: self._press(item))
        self._buttons.append((item, handle, hotkey))
        self._places.append(placed(panel.name, by_id(handle._impl.uuid), item.box))

    def place_after(self, panel: str, mark: str, box: Box) -> None:
        """The widget after the HTML marked so: a text field's own id is deep within it."""
        self._places.append(placed(panel, after(mark), box))

    @property
    def style(self) -> str:
        """Places of all widgets, once they are made."""
        return " ".join(self._places)

    def _press(self, item: Item) -> None:
        """The guard: whatever a client sends, a press that cannot act is refused here, and in the app once more."""
        telemetry, fresh = self._latest()
        why = withheld(telemetry, fresh)
        if not why and telemetry is not None:
            why = item.reason(telemetry)
        if why or telemetry is None:
            self._refuse(item.label, why)
            return
        word = item.asks(telemetry)
        if word is not None:
            self._say(word)

    def live(self, telemetry: Telemetry | None, fresh: Freshness) -> list[Live]:
        """Every button as it is now."""
        general = withheld(telemetry, fresh)
        found = []
        for item, handle, hotkey in self._buttons:
            why = general or (item.reason(telemetry) if telemetry is not None else "")
            line = why or (hint(Page.CONSOLE, item.action) if item.action else "")
            found.append(Live(button=handle, hotkey=hotkey, enabled=not why, label=item.label, line=line))
        return found

    def show(self, telemetry: Telemetry | None) -> None:
        for panel, handle in self._words:
            handle.content = _frame(panel, telemetry)


def _frame(panel: Panel, telemetry: Telemetry | None) -> str:
    return (
        f'<div class="far-card far-panel panel-{panel.name}" id="op-{panel.name}"><h2>{panel.title}</h2>'
        f"{panel.html(telemetry)}</div>"
    )


def _frame_place(panel: Panel) -> str:
    return (
        f"div:has(> .panel-{panel.name}) {{ left: var(--panel-left); top: var(--panel-top); "
        f"width: calc(33 * var(--u)); height: calc({panel.height} * var(--u)); z-index: 30 !important; }} "
        f"{closed(panel.name)} div:has(> .panel-{panel.name}) {{ display: none; }}"
    )


def by_id(uuid: str) -> str:
    """The selector of a widget."""
    return f'div:has(> [id="{uuid}"])'


def after(mark: str) -> str:
    """The selector of the widget after the HTML marked so."""
    return f"div:has(> .{mark}) + div"


def placed(panel: str, selector: str, box: Box) -> str:
    """A widget of a panel: where it is, and that it is hidden with its panel."""
    left, top, width, height = box
    return (
        f"{selector} {{ left: calc(var(--panel-left) + {left} * var(--u)); "
        f"top: calc(var(--panel-top) + {top} * var(--u)); width: calc({width} * var(--u)); "
        f"height: calc({height} * var(--u)); z-index: 31 !important; }} "
        f"{closed(panel)} {selector} {{ display: none; }}"
    )


OPENS_IN = {"demo": "KEEP IT?", "steer": "TAKEN OVER"}
"""Panel to the state in which it opens by itself."""


def closed(panel: str) -> str:
    """The selector of a page in which this panel is not to be seen: its tab is closed, and it does not open by itself,
    which an open tab of another prevents."""
    tab = f"body:not(:has(#far-tab-{panel}[open]))"
    if panel not in OPENS_IN:
        return tab
    return f'{tab}:is(:not(:has(#op-state[data-state="{OPENS_IN[panel]}"])), :has(.far-tabs details[open]))'
