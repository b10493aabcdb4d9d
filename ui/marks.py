"""The panel for a person's word on attempts: the program's judgment, the last word beside it, a note."""

from __future__ import annotations

from html import escape

import viser

from far_app.marks import NOTE_LIMIT, Judged, Mark, MarkAttempt, Verdict, trouble
from far_app.session_states import State
from far_app.telemetry import Telemetry
from ui.keys import EARLIER, LATER, UNSURE
from ui.page_server import Presses
from ui.panels import AMBER, GREEN, QUIET, Item, Panels

_UNDER_WAY = (State.RUNNING, State.TAKEN_OVER, State.PAUSED)


class Marks:
    """ui.panels.Panel; which attempt is chosen is the page's own, and every viewer's."""

    name, title, height = "marks", "Marks", 19.6

    def __init__(self) -> None:
        self._back = 0
        """How many attempts before the newest."""
        self._draft = ""
        self._field: viser.GuiTextHandle | None = None
        self.items = [
            Item(label="Earlier", box=(0.8, 9.4, 7.4, 4.1), reason=self._no_earlier, asks=self._earlier,
                 action=EARLIER),
            Item(label="Later", box=(8.7, 9.4, 7.4, 4.1), reason=self._no_later, asks=self._later, action=LATER),
            Item(label="Success", box=(16.6, 9.4, 7.4, 4.1), color=GREEN,
                 reason=lambda t: self._cannot(t, Verdict.SUCCESS), asks=lambda t: self._word(t, Verdict.SUCCESS)),
            Item(label="Failure", box=(24.5, 9.4, 7.7, 4.1), color=AMBER,
                 reason=lambda t: self._cannot(t, Verdict.FAILURE), asks=lambda t: self._word(t, Verdict.FAILURE)),
            Item(label="Unsure", box=(0.8, 14.4, 7.4, 4.1), color=QUIET, action=UNSURE,
                 reason=lambda t: self._cannot(t, Verdict.UNSURE), asks=lambda t: self._word(t, Verdict.UNSURE)),
            Item(label="Keep note", box=(24.5, 14.4, 7.7, 4.1), reason=self._no_note, asks=self._note),
        ]  # fmt: skip

    def add_field(self, gui: viser.GuiApi, presses: Presses, panels: Panels) -> None:
        """The field of the note."""
        gui.add_html('<div class="mark-note"></div>')
        self._field = gui.add_text("note", "", hint="a note on this attempt")
        presses.on_text(self._field, self._write, NOTE_LIMIT)
        panels.place_after(self.name, "mark-note", (8.7, 14.4, 15.3, 4.1))

    def _write(self, text: str) -> None:
        self._draft = text

    def chosen(self, telemetry: Telemetry) -> Judged | None:
        """The attempt the buttons are about: one that ended, or (with nothing gone back) the one under way."""
        ended = telemetry.attempts
        if self._running(telemetry):
            if self._back == 0:
                return None
            return ended[-self._back] if self._back <= len(ended) else None
        return ended[-1 - self._back] if self._back < len(ended) else None

    def _running(self, telemetry: Telemetry) -> bool:
        return telemetry.state in _UNDER_WAY and telemetry.trial > 0

    def _known(self, telemetry: Telemetry) -> int:
        return len(telemetry.attempts) + self._running(telemetry)

    def _no_earlier(self, telemetry: Telemetry) -> str:
        return "" if self._back + 1 < self._known(telemetry) else "this is the first"

    def _no_later(self, telemetry: Telemetry) -> str:
        return "" if self._back > 0 else "this is the newest"

    def _earlier(self, telemetry: Telemetry) -> None:
        self._back += 1

    def _later(self, telemetry: Telemetry) -> None:
        self._back -= 1

    def _place(self, telemetry: Telemetry) -> tuple[int, int] | None:
        judged = self.chosen(telemetry)
        if judged is not None:
            return judged.trial, judged.attempt
        return (telemetry.trial, telemetry.attempt) if self._running(telemetry) and self._back == 0 else None

    def _cannot(self, telemetry: Telemetry, verdict: Verdict) -> str:
        judged = self.chosen(telemetry)
        if judged is not None:
            return "you said so" if judged.verdict is verdict else ""
        if self._place(telemetry) is None:
            return "no attempt yet"
        return "" if verdict is Verdict.UNSURE else "it is under way"

    def _no_note(self, telemetry: Telemetry) -> str:
        if self._place(telemetry) is None:
            return "no attempt yet"
        return "" if self._draft.strip() else "write one first"

    def _word(self, telemetry: Telemetry, verdict: Verdict | None, note: str = "") -> MarkAttempt | None:
        place = self._place(telemetry)
        if place is None:
            return None
        mark = Mark(trial=place[0], attempt=place[1], verdict=verdict, note=note)
        return None if trouble(mark) else MarkAttempt(session=telemetry.session, mark=mark)

    def _note(self, telemetry: Telemetry) -> MarkAttempt | None:
        note, self._draft = self._draft.strip(), ""
        if self._field is not None:
            self._field.value = ""
        return self._word(telemetry, None, note)

    def html(self, telemetry: Telemetry | None) -> str:
        if telemetry is None or (place := self._place(telemetry)) is None:
            return '<p class="far-line">No attempt yet.</p>'
        return both(place, self.chosen(telemetry), "under way")


def both(place: tuple[int, int], judged: Judged | None, otherwise: str) -> str:
    """The program's judgment of a (trial, attempt) and a person's word beside it, as HTML; `otherwise`: what it is
    where nobody has judged it."""
    program = otherwise if judged is None else f"{'success' if judged.success else 'failure'} ({judged.judged_by})"
    person = "nothing yet"
    if judged is not None and (judged.verdict or judged.note):
        person = ", ".join(part for part in (judged.verdict, judged.by and f"by {judged.by}", judged.note) if part)
    tone = "idle" if judged is None else {True: "good", False: "warn", None: "learn"}[judged.final]
    return (
        f'<p class="far-line"><b>Trial {place[0]}, attempt {place[1]}</b></p>'
        f'<p class="far-line">program: {escape(program)}</p>'
        f'<p class="far-line tone-{tone}">person: {escape(person)}</p>'
    )
