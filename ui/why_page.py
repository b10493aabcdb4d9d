"""The attempt view's widgets: built once, updated where something changed. Presses and sliders only enqueue."""

from __future__ import annotations

import queue
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import viser

from far_app.marks import Judged, Mark
from ui import why_html
from ui.keys import Page, add_hotkey, hint, key_of
from ui.page_server import Presses
from ui.presence import Presence
from ui.scene3d import BRAND
from ui.viewers import Live, Viewers
from ui.why_marks import WhyMarks
from ui.why_model import Attribution, Case
from ui.why_scene import WhyScene
from ui.why_state import Looking, Offer, Press

_STYLE = "".join((Path(__file__).parent / name).read_text(encoding="utf-8") for name in ("style.css", "why.css"))
_QUIET, _AMBER, _VIOLET = (36, 50, 65), (140, 92, 16), (86, 52, 150)
_SETTLE = 0.8
"""Seconds after a slider's last move before it is set for the other viewers too."""

_BUTTONS: tuple[tuple[Press, str, tuple[int, int, int], int, int], ...] = (
    (Press.PREVIOUS, "◀ Flagged", BRAND, 0, 0),
    (Press.NEXT, "Flagged ▶", BRAND, 1, 0),
    (Press.EARLIER, "◀ Tick", _QUIET, 0, 1),
    (Press.LATER, "Tick ▶", _QUIET, 1, 1),
    (Press.ATTEMPT_PREVIOUS, "◀ Attempt", _QUIET, 0, 2),
    (Press.ATTEMPT_NEXT, "Attempt ▶", _QUIET, 1, 2),
    (Press.CORRECT, "Correct", _AMBER, 0, 3),
    (Press.ADAPT, "Adapt again", _VIOLET, 1, 3),
    (Press.CRITIC, "Critic", _QUIET, 0, 4),
    (Press.RESET, "As recorded", _QUIET, 1, 4),
)


@dataclass(frozen=True, kw_only=True)
class Shown:
    """Everything the page says at one moment."""

    looking: Looking
    case: Case | None
    found: Attribution | None
    attempts: int
    scale: float
    offers: Mapping[Press, Offer]
    unreadable: str = ""
    note: str = ""
    """Below the positives: being drawn, or why there are none."""
    lesson: Any = None
    """The Answer of the latest adapt-again of this attempt."""
    moved: tuple[np.ndarray, np.ndarray] | None = None
    moved_words: str = ""
    place: tuple[int, int] | None = None
    """(trial, attempt)."""
    judged: Judged | None = None
    marks: tuple[Mark, ...] = ()
    """People's words on it, oldest first."""
    session: str = ""
    problems: tuple[str, ...] = ()
    said: str = ""
    link: str = ""


class WhyPage:
    """One page for all clients. `show` from one thread only."""

    def __init__(self, server: viser.ViserServer, presence: Presence, *, scene3d: bool = True) -> None:
        self.events: queue.SimpleQueue[tuple[Press, float]] = queue.SimpleQueue()
        """What was pressed, oldest first; a slider's with its value."""
        self._gui, self._presses = server.gui, Presses(server, presence)
        self.refusals: queue.SimpleQueue[str] = queue.SimpleQueue()
        """What was refused for want of control, and why."""
        self._presses.refused = lambda what, why: self.refusals.put(f"{what} is refused: {why}")
        self._buttons: dict[Press, tuple[str, viser.GuiButtonHandle, viser.CommandHandle]] = {}
        self._sliders: list[tuple[Press, viser.GuiSliderHandle[Any]]] = []
        self._touched: dict[Press, float] = {}
        server.gui.configure_theme(dark_mode=True, brand_color=BRAND, show_logo=False, show_share_button=False)
        server.gui.set_panel_label("FAR: why did it fail")
        self._scene = WhyScene(server) if scene3d else None
        self._drawn: tuple[object, ...] = ()
        self._build()
        self._viewers = Viewers(server, self._presses, presence, Page.WHY)

    def _build(self) -> None:
        gui = self._gui
        gui.add_html('<div class="far-root far-whyroot"></div>')
        self._head = gui.add_html(why_html.head(None, None, 0, 0, 0, "opening the session"))
        places = [self._add_button(*button) for button in _BUTTONS]
        self._add_slider(Press.TICK, "tick", 0, 150, 1)
        self._add_slider(Press.RHO, "ρ, % flagged", 1, 50, 1)
        self._add_slider(Press.HORIZON, "H, ticks of a chunk", 1, 32, 1)
        self._lesson = gui.add_html(why_html.lesson(None, ""))
        self._frames = gui.add_html(why_html.frames(None, 0, 0, False))
        gui.add_html(why_html.key())
        self._charts = gui.add_html(why_html.charts(None, 0))
        self._add_slider(Press.TICK, "", 0, 150, 1, slot="pick")  # unseen, over the charts: a click or a drag there
        self._numbers = gui.add_html(why_html.numbers(None, None, 0, ""))
        self._foot = gui.add_html(why_html.foot("", (), "", ""))
        self.marks = WhyMarks(gui, self._presses, lambda press: self.events.put((press, 0.0)))
        places.append(self.marks.style)
        gui.add_html(f"<style>{_STYLE}\n@media (min-width: 768px) {{ {' '.join(places)} }}</style>")

    def _add_button(self, press: Press, label: str, color: tuple[int, int, int], column: int, row: int) -> str:
        handle = self._gui.add_button(label, disabled=True, color=color)
        key = key_of(Page.WHY, press)
        assert key is not None
        command = add_hotkey(self._gui, key, label, disabled=True)
        self._presses.on(handle, lambda: self.events.put((press, 0.0)))
        self._presses.on(command, lambda: self.events.put((press, 0.0)))
        self._buttons[press] = (label, handle, command)
        return (
            f'div:has(> [id="{handle._impl.uuid}"]) {{ left: calc({(0.7, 11.6)[column]} * var(--u)); '
            f"width: calc(10.2 * var(--u)); top: calc(var(--head) + {0.7 + 4.35 * row} * var(--u)); "
            f"height: calc(3.85 * var(--u)); }}"
        )

    def _add_slider(self, press: Press, label: str, low: float, high: float, step: float, slot: str = "") -> None:
        self._gui.add_html(f'<div class="why-slot slot-{slot or press.value}">{label}</div>')
        slider = self._gui.add_slider(" ", min=low, max=high, step=step, initial_value=low)
        self._presses.on_value(slider, lambda value: self._slid(press, value))
        self._sliders.append((press, slider))

    def _slid(self, press: Press, value: float) -> None:
        self._touched[press] = time.monotonic()
        self.events.put((press, value))

    def show(self, s: Shown) -> None:
        """viser sends only what changed."""
        tick, case, found = s.looking.tick, s.case, s.found
        flagged = found is not None and tick in found.flagged
        horizon = found.horizon if found is not None else 0
        self._head.content = why_html.head(case, found, tick, s.looking.attempt, s.attempts, s.unreadable, s.judged)
        self._frames.content = why_html.frames(case, tick, horizon, flagged)
        self._charts.content = why_html.charts(found, tick)
        self._numbers.content = why_html.numbers(case, found, tick, s.note)
        self._lesson.content = why_html.lesson(s.lesson, s.moved_words)
        self._foot.content = why_html.foot(s.session, s.problems, s.said, s.link)
        names = {
            Press.CORRECT: "Unflag" if flagged else "Flag",
            Press.CRITIC: s.looking.choice.critic.rsplit("/", 1)[-1].removesuffix(".safetensors"),
        }
        live: list[Live] = []
        for press, (label, handle, hotkey) in self._buttons.items():
            offer = s.offers[press]
            line = f"{offer.line} · {hint(Page.WHY, press)}".removeprefix(" · ") if offer.enabled else offer.line
            name = names.get(press, label)
            live.append(Live(button=handle, hotkey=hotkey, enabled=offer.enabled, label=name, line=line))
        self.marks.show(s.place, s.judged, s.marks)
        self._viewers.show([*live, *self.marks.live(s.offers)])
        self._set_sliders(s)
        if self._scene is not None:
            key = (id(case), id(found), tick, id(s.moved))
            if key != self._drawn:
                self._scene.show(case, found, tick, s.scale, s.moved)
                self._drawn = key
                self._kept = (case, found, s.moved)  # ids stay theirs while we hold them

    def _set_sliders(self, s: Shown) -> None:
        last = max(1, s.case.length - 1) if s.case is not None else 1
        values = {
            Press.TICK: s.looking.tick, Press.RHO: s.looking.choice.rho, Press.HORIZON: s.looking.choice.horizon,
        }  # fmt: skip
        for press, slider in self._sliders:
            if press is Press.TICK and slider.max != last:
                slider.value = min(slider.value, last)
                slider.max = last
            settled = time.monotonic() - self._touched.get(press, 0.0) > _SETTLE
            if settled and slider.value != values[press]:
                slider.value = values[press]

    @property
    def unsettled(self) -> bool:
        """A slider was just moved: show once more when it rests."""
        return any(time.monotonic() - t < 2 * _SETTLE for t in self._touched.values())
