"""What a client's message may do: press what is there, move a slider within its limits, and only with control."""

from __future__ import annotations

import atexit
import math
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
import viser
from ui_process import free_port, wait_until

from ui.access import Access
from ui.page_server import Presses, open_page
from ui.presence import Presence
from ui.raw_client import RawClient


class Served:
    """A page with one button, one for everyone, and one slider; `did` is what came of the messages."""

    def __init__(self, port: int = 0) -> None:
        presence = Presence()
        self.server = open_page(Access(), port, presence, {"there": "http://127.0.0.1:1/?x=1"}.get)
        self.url = f"http://127.0.0.1:{self.server.get_port()}"
        self.did: list[Any] = []
        presses = Presses(self.server, presence)
        presses.refused = lambda what, why: self.did.append((what, why))
        self.button = self.server.gui.add_button("Act")
        self.common = self.server.gui.add_button("Help")
        self.slider = self.server.gui.add_slider("H", min=1, max=32, step=1, initial_value=8)
        self.field = self.server.gui.add_text("note", "")
        presses.on(self.button, lambda: self.did.append("acted"))
        presses.on(self.common, lambda: self.did.append("helped"), everyone=True)
        presses.on_value(self.slider, self.did.append)
        presses.on_text(self.field, self.did.append, 12)


@pytest.fixture
def served() -> Iterator[Served]:
    page = Served()
    yield page
    page.server.stop()


def test_who_comes_while_the_page_is_being_made_is_served_once_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a browser does that lost the page before: the port is open before viser's server is complete, which then
    lacks what a connection needs and would close it."""
    register, came = atexit.register, threading.Event()
    pages: list[Served] = []

    def slow(function: Any, *words: Any) -> Any:
        if isinstance(getattr(function, "__self__", None), viser.ViserServer):  # it listens, and has no event loop yet
            came.wait(5.0)
            time.sleep(0.3)
        return register(function, *words)

    monkeypatch.setattr(atexit, "register", slow)
    port = free_port()
    making = threading.Thread(target=lambda: pages.append(Served(port)))
    making.start()
    client = connected(port)
    came.set()
    making.join()
    assert client.read(10.0, lambda: client.find("Act") is not None)
    client.close()
    pages[0].server.stop()


def connected(port: int) -> RawClient:
    """As soon as the port takes connections."""
    for _ in range(500):
        try:
            return RawClient(f"http://127.0.0.1:{port}")
        except OSError:
            time.sleep(0.01)
    raise AssertionError(f"nobody listens on {port}")


def slide(client: RawClient, page: Served, value: object) -> None:
    client.send({"type": "GuiUpdateMessage", "uuid": page.slider._impl.uuid, "updates": {"value": value}})


def test_a_slider_takes_finite_numbers_and_keeps_them_within_its_limits(served: Served) -> None:
    client = RawClient(served.url)
    for value in (12, 1e9, -5, math.nan, math.inf, True, "12", None, [1]):
        slide(client, served, value)
    assert wait_until(lambda: len(served.did) >= 3)
    client.read(0.3)
    assert served.did == [12.0, 32.0, 1.0]
    client.close()


def test_a_text_field_gives_one_line_within_its_limit_and_can_be_emptied(served: Served) -> None:
    client = RawClient(served.url)
    assert client.read(5, lambda: served.field._impl.uuid in client.widgets)
    for value in ("fell down", "a\tb\nc", "x" * 40, 3, None):
        client.send({"type": "GuiUpdateMessage", "uuid": served.field._impl.uuid, "updates": {"value": value}})
    assert wait_until(lambda: len(served.did) == 3)
    client.read(0.3)
    assert served.did == ["fell down", "a b c", "x" * 12]
    served.field.value = ""
    assert client.read(5, lambda: client.widgets[served.field._impl.uuid].get("value") == ""), "the browser is told"
    client.close()


def test_without_control_only_what_is_everyone_s_acts(served: Served) -> None:
    first, second = RawClient(served.url), RawClient(served.url)
    slide(second, served, 12)
    second.press(served.button._impl.uuid)
    second.press(served.common._impl.uuid)
    assert wait_until(lambda: len(served.did) == 3)
    why = "viewer 1 holds control"
    assert served.did == [("a slider", why), ("Act", why), "helped"]
    first.press(served.button._impl.uuid)
    assert wait_until(lambda: served.did[-1] == "acted")
    first.close()
    second.close()


def test_a_message_with_more_than_a_press_is_no_press(served: Served) -> None:
    client = RawClient(served.url)
    uuid = served.button._impl.uuid
    for updates in ({"value": True, "disabled": False}, {"value": 1.5}, {"label": "x"}, {}):
        client.send({"type": "GuiUpdateMessage", "uuid": uuid, "updates": updates})
    client.press(uuid)
    assert wait_until(lambda: served.did == ["acted"])
    assert served.button.label == "Act"
    client.close()
