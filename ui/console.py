"""The operator page: builds viser's widgets once and updates what changed. Callbacks only enqueue.

Shared widgets (server.gui), so late joiners see everything; look and place of each are style.css's.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import viser

from far_app.session_states import Intent, State
from far_app.telemetry import Telemetry, View
from far_app.types import RobotMode
from ui import html
from ui.demonstration import Demonstration
from ui.keys import Page, add_hotkey, hint, key_of
from ui.lineage import Lineage
from ui.marks import Marks
from ui.page_server import Presses
from ui.panels import BLUE, Panels
from ui.plots import Plots
from ui.presence import Presence
from ui.scene3d import BRAND, FLAGGED, Scene3D
from ui.scene_overlay import SceneOverlay
from ui.stop import StopLine
from ui.take_over import TakeOver
from ui.tick_strip import tick_strip
from ui.trials_panel import TrialsPanel
from ui.view_model import Freshness, adaptation, arm_word, banner, camera_note, control, loop_gauges, summary
from ui.viewers import Live, Viewers

PLACES = ("front", "wrist")
"""On the page, left to right, as style.css names them, whatever the views are called; more of them: the rerun page."""
CONFIRM = 4.0
"""Seconds within which a second click ends the session."""
_HERE = Path(__file__).parent
_STYLE = "\n".join((_HERE / sheet).read_text(encoding="utf-8") for sheet in ("style.css", "tick_strip.css"))
_BLANK = np.full((8, 8, 3), 8, np.uint8)


@dataclass(frozen=True, kw_only=True)
class _Button:
    intent: Intent
    label: str
    color: tuple[int, int, int]
    box: tuple[float, float, float, float]
    """Left, top, width, height in page units, below the head."""


_QUIET, _GREEN, _AMBER = (36, 50, 65), (31, 122, 77), (140, 92, 16)
_COLUMNS, _WIDTH, _HEIGHT = (0.7, 12.15), 10.85, 4.3


def _control(intent: Intent, label: str, color: tuple[int, int, int], column: int, row: int) -> _Button:
    box = (_COLUMNS[column], 11.7 + 4.9 * row, _WIDTH, _HEIGHT)
    return _Button(intent=intent, label=label, color=color, box=box)


_BUTTONS = (
    _control(Intent.PAUSE, "Pause", _QUIET, 0, 0),
    _control(Intent.RESUME, "Resume", BRAND, 1, 0),
    _control(Intent.MARK_SUCCESS, "Mark success", _GREEN, 0, 1),
    _control(Intent.MARK_FAILURE, "Mark failure", _AMBER, 1, 1),
    _control(Intent.SKIP_TRIAL, "Skip trial", _QUIET, 0, 2),
    _control(Intent.SCENE_READY, "Scene ready", BRAND, 1, 2),
    _Button(intent=Intent.TAKE_OVER, label="Take over", color=BLUE, box=(0.7, 26.4, 10.85, 3.3)),
    _Button(intent=Intent.HAND_BACK, label="Hand back", color=_AMBER, box=(0.7, 26.4, 10.85, 3.3)),
    _Button(intent=Intent.QUIT, label="End session", color=_QUIET, box=(12.15, 26.4, 10.85, 3.3)),
)


class Console:
    """One page for all clients. `update` is called from one thread only."""

    def __init__(
        self,
        server: viser.ViserServer,
        stop_line: StopLine,
        presence: Presence,
        latest: Callable[[], tuple[Telemetry | None, Freshness]],
        *,
        scene3d: bool,
        cameras: Sequence[str] = PLACES,
    ) -> None:
        self._cameras = cameras
        self.pressed: queue.SimpleQueue[Any] = queue.SimpleQueue()
        """Intents and other words that passed the guard, for the caller to send."""
        self.refusal = ""
        """Why the page itself refused the last press."""
        self._gui, self._stop, self._latest = server.gui, stop_line, latest
        self._server, self._presence = server, presence
        self._presses = Presses(server, presence)
        self._presses.refused = self.refuse
        self._refused_at = self._ending_until = 0.0
        self._beats = 0
        self._images: dict[str, viser.GuiImageHandle] = {}
        self._pictures: dict[str, bytes] = {}
        self._captions: dict[str, tuple[viser.GuiHtmlHandle, str]] = {}
        """Above each camera's picture, and its place's mark."""
        self._controls: dict[Intent, tuple[_Button, viser.GuiButtonHandle, viser.CommandHandle | None]] = {}
        server.gui.configure_theme(dark_mode=True, brand_color=BRAND, show_logo=False, show_share_button=False)
        server.gui.set_panel_label("FAR")
        self.scene = Scene3D(server) if scene3d else None
        self._build()

    def _build(self) -> None:
        gui = self._gui
        fresh = Freshness()
        self._root = gui.add_html('<div class="far-root"></div>')
        self._beat = gui.add_html(html.beat(0, fresh))
        self._head = gui.add_html(html.head(banner(None, fresh), arm_word(None)))
        stop = gui.add_button("STOP", color=FLAGGED)
        self._stop_note = gui.add_html(html.stop_note(None, False, ""))
        hotkey = self._hotkey(Intent.STOP, "STOP the arm")
        assert hotkey is not None

        self._presses.on(stop, lambda: self._press_stop("page: button"), everyone=True)
        self._presses.on(hotkey, lambda: self._press_stop("page: space key"), everyone=True)
        places = [_place(stop, (0.7, 0.7, 22.3, 8.6)), _big(stop)]
        places += [self._add_control(button) for button in _BUTTONS]
        self._adapt = gui.add_html(html.adaptation(adaptation(None)))
        self._history = gui.add_html(html.history((), summary(())))
        self._events = gui.add_html(html.events((), 0.0))
        self._strip = gui.add_html(tick_strip(None))
        self._add_cameras()
        self.plots = Plots(gui)
        self._panels = self._add_panels()
        self._plan, self._overlay = TrialsPanel(gui), SceneOverlay(gui, self._presses)
        self._foot = gui.add_html(html.foot((), "", None, ""))
        self._viewers = Viewers(self._server, self._presses, self._presence, Page.CONSOLE)
        gui.add_html(
            f"<style>{_STYLE}\n@media (min-width: 768px) {{ {' '.join(places)} {self._panels.style} }}</style>"
        )

    def _add_control(self, button: _Button) -> str:
        handle = self._gui.add_button(button.label, disabled=True, color=button.color)

        self._presses.on(handle, lambda: self._press(button.intent))
        command = self._hotkey(button.intent, button.label, disabled=True)
        if command is not None:
            self._presses.on(command, lambda: self._press(button.intent, by_key=True))
        self._controls[button.intent] = (button, handle, command)
        return _place(handle, button.box)

    def _hotkey(self, action: str, label: str, *, disabled: bool = False) -> viser.CommandHandle | None:
        key = key_of(Page.CONSOLE, action)
        return add_hotkey(self._gui, key, label, disabled=disabled) if key is not None else None

    def _add_panels(self) -> Panels:
        marks = Marks()
        every = (TakeOver(), marks, Lineage(), Demonstration())
        panels = Panels(self._gui, self._presses, self._latest, self.pressed.put, self.refuse, every)
        marks.add_field(self._gui, self._presses, panels)
        return panels

    def _add_cameras(self) -> None:
        for camera, place in zip(self._cameras, PLACES, strict=False):
            self._captions[camera] = (self._gui.add_html(html.caption(camera, "", f"mark-{place}")), f"mark-{place}")
            self._images[camera] = self._gui.add_image(_BLANK, format="jpeg")

    def _press_stop(self, source: str) -> None:
        self._stop.press(source)
        self.pressed.put(Intent.STOP)

    def _press(self, intent: Intent, by_key: bool = False) -> None:
        """The guard: viser does not enforce `disabled`, a raw client may press anything at any time."""
        telemetry, fresh = self._latest()
        asked = control(intent, telemetry, fresh)
        if by_key and intent is Intent.RESUME and asked.enabled and telemetry and telemetry.state is not State.PAUSED:
            self.refuse(intent.value, "after a stop or a fault, click it")
        elif asked.enabled and intent is Intent.QUIT and time.monotonic() > self._ending_until:
            self._ending_until = time.monotonic() + CONFIRM
        elif asked.enabled:
            self.pressed.put(intent)
        else:
            self.refuse(intent.value, asked.reason)

    def _hint(self, button: _Button, telemetry: Telemetry | None) -> str:
        if button.intent is Intent.RESUME and telemetry is not None and telemetry.state is not State.PAUSED:
            return "the arm may move"
        if button.intent is Intent.QUIT and time.monotonic() < self._ending_until:
            return "click again to end it"
        return hint(Page.CONSOLE, button.intent)

    def refuse(self, what: str, reason: str) -> None:
        """Say on the page that a press had no effect, and why."""
        self.refusal = f"{what.replace('_', ' ').lower()} refused: {reason}"
        self._refused_at = time.monotonic()

    def beat(self, fresh: Freshness) -> None:
        """Twice a second while all is well: keeps the browser's dead-man overlay down."""
        self._beats += 1
        self._beat.content = html.beat(self._beats, fresh)

    def text(
        self,
        telemetry: Telemetry | None,
        view: View | None,
        fresh: Freshness,
        viewer: str | None,
        why: str | None = None,
    ) -> None:
        """Words, buttons, tables; viser sends only what changed. `viewer` is where rerun shows the session, `why` its
        attempt view."""
        taken_over = telemetry is not None and telemetry.state is State.TAKEN_OVER
        status = view.status if view is not None and not fresh.hw_silent else None
        self._head.content = html.head(banner(telemetry, fresh), arm_word(status, taken_over))
        latched = status is not None and status.mode is RobotMode.LATCHED
        self._stop_note.content = html.stop_note(self._stop.result, latched, status.reason if status else "")
        self._show_controls(telemetry, fresh, taken_over)
        self._panels.show(telemetry)
        self._plan.show(telemetry)
        self._overlay.show(telemetry, view)
        for camera, (handle, mark) in self._captions.items():
            note, tone = camera_note(view.cameras.get(camera) if view is not None else None)
            handle.content = html.caption(camera, note, mark, tone)
        self._adapt.content = html.adaptation(adaptation(telemetry))
        refusal = self.refusal if time.monotonic() - self._refused_at < 6 else ""
        gauges, session = loop_gauges(telemetry), telemetry.session if telemetry else ""
        if telemetry is not None:
            self._strip.content = tick_strip(telemetry)
            self._history.content = html.history(telemetry.history, summary(telemetry.history))
            self._events.content = html.events(telemetry.log, telemetry.stamp)
            refusal = refusal or telemetry.refusal
        self._foot.content = html.foot(gauges, refusal, viewer, session, why)

    def _show_controls(self, telemetry: Telemetry | None, fresh: Freshness, taken_over: bool) -> None:
        live: list[Live] = []
        for intent, (button, handle, hotkey) in self._controls.items():
            now = control(intent, telemetry, fresh)
            line = self._hint(button, telemetry) if now.enabled else now.reason
            live.append(Live(button=handle, hotkey=hotkey, enabled=now.enabled, label=button.label, line=line))
        for intent, there in ((Intent.TAKE_OVER, not taken_over), (Intent.HAND_BACK, taken_over)):
            self._controls[intent][1].visible = there
        self._viewers.show([*live, *self._panels.live(telemetry, fresh)])

    def pictures(self, view: View) -> None:
        """The cameras' JPEGs as they came: no decoding and no encoding on the way to the browser."""
        for camera, image in self._images.items():
            jpeg = view.jpegs.get(camera)
            if jpeg is not None and jpeg is not self._pictures.get(camera):
                image._data = jpeg
                self._pictures[camera] = jpeg


def _place(handle: viser.GuiButtonHandle, box: tuple[float, float, float, float]) -> str:
    left, top, width, height = box
    return (
        f'div:has(> [id="{handle._impl.uuid}"]) {{ left: calc({left} * var(--u)); width: calc({width} * var(--u)); '
        f"top: calc(var(--head) + {top} * var(--u)); height: calc({height} * var(--u)); }}"
    )


def _big(handle: viser.GuiButtonHandle) -> str:
    """STOP: large, white on red; above the overlay of a silent app, below that of a lost page, where it is dead."""
    button = f'button[id="{handle._impl.uuid}"].mantine-Button-root'
    lost = 'div[style*="pointer-events: none"] > div'
    return (
        f"{button} {{ color: #fff !important; }} "
        f"{button} .mantine-Button-label::first-line {{ font-size: calc(4.6 * var(--u)); font-weight: 800; "
        f"letter-spacing: .04em; }} div:has(> {button}) {{ z-index: 70 !important; }} "
        f"{lost} > div:has(> {button}) {{ z-index: 20 !important; }}"
    )
