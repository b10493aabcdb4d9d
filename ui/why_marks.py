"""The attempt view's panel of marks: the program's judgment of the attempt on show, every word of people on it, and
what adds another. Its tab lies over the 3D view, as on the operator's page; look and place are why.css's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape

import viser

from far_app.marks import NOTE_LIMIT, Judged, Mark
from ui.keys import Page, add_hotkey, hint, key_of
from ui.marks import both
from ui.page_server import Presses
from ui.panels import AMBER, GREEN, QUIET, Box, after, by_id, placed
from ui.viewers import Live
from ui.why_state import Offer, Press

NAME = "marks"
_BUTTONS: tuple[tuple[Press, str, tuple[int, int, int], Box], ...] = (
    (Press.MARK_SUCCESS, "Success", GREEN, (0.8, 13.7, 8.8, 4.1)),
    (Press.MARK_FAILURE, "Failure", AMBER, (10.0, 13.7, 8.8, 4.1)),
    (Press.MARK_UNSURE, "Unsure", QUIET, (19.2, 13.7, 8.8, 4.1)),
    (Press.KEEP_NOTE, "Keep note", QUIET, (19.2, 18.5, 8.8, 4.1)),
)
_NOTE: Box = (0.8, 18.5, 18.0, 4.1)


class WhyMarks:
    """Its widgets; `show` and `live` from one thread, presses only enqueue."""

    def __init__(self, gui: viser.GuiApi, presses: Presses, press: Callable[[Press], None]) -> None:
        self.note = ""
        """What is written in the field."""
        tab = f'<details id="far-tab-{NAME}"><summary>Marks</summary></details>'
        gui.add_html(f'<div class="far-tabs">{tab}</div>')
        self._words = gui.add_html(panel(None, None, ()))
        self._buttons: list[tuple[Press, str, viser.GuiButtonHandle, viser.CommandHandle | None]] = []
        places = []
        for what, label, color, box in _BUTTONS:
            handle = gui.add_button(label, disabled=True, color=color)
            presses.on(handle, lambda what=what: press(what))
            key = key_of(Page.WHY, what)
            hotkey = add_hotkey(gui, key, label, disabled=True) if key is not None else None
            if hotkey is not None:
                presses.on(hotkey, lambda what=what: press(what))
            self._buttons.append((what, label, handle, hotkey))
            places.append(placed(NAME, by_id(handle._impl.uuid), box))
        gui.add_html('<div class="mark-note"></div>')
        self._field = gui.add_text("note", "", hint="a note on this attempt")
        presses.on_text(self._field, self._write, NOTE_LIMIT)
        self.style = " ".join([*places, placed(NAME, after("mark-note"), _NOTE)])

    def _write(self, text: str) -> None:
        self.note = text

    def take_note(self) -> str:
        """What was written; the field is empty then."""
        note, self.note = self.note.strip(), ""
        self._field.value = ""
        return note

    def live(self, offers: Mapping[Press, Offer]) -> list[Live]:
        """Every button as it is now."""
        return [
            Live(button=handle, hotkey=hotkey, enabled=offers[what].enabled, label=label,
                 line=offers[what].line or hint(Page.WHY, what))
            for what, label, handle, hotkey in self._buttons
        ]  # fmt: skip

    def show(self, place: tuple[int, int] | None, judged: Judged | None, words: Sequence[Mark]) -> None:
        self._words.content = panel(place, judged, words)


def panel(place: tuple[int, int] | None, judged: Judged | None, words: Sequence[Mark]) -> str:
    """HTML: the judgments beside each other, then each word with who and when, newest first."""
    said = both(place, judged, "it has not ended") if place is not None else '<p class="far-line">No attempt yet.</p>'
    lines = "".join(
        f"<p><b>{escape(word.wall[:16].replace('T', ' '))}</b> {escape(word.by or 'a person')}: "
        f"{escape(' · '.join(part for part in (word.verdict, word.note) if part))}</p>"
        for word in reversed(words)
    )
    return (
        f'<div class="far-card far-panel panel-{NAME}" id="why-marks"><h2>Marks</h2>{said}'
        f'<div class="why-words">{lines}</div></div>'
    )
