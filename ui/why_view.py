"""What the attempt view shows and what a press does: one View a page, one thread. Called by ui/why.py."""

from __future__ import annotations

import queue
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from far_app.marks import Mark, MarkAttempt
from far_app.recording.said_lines import now as wall_clock
from far_app.types import FlagCorrection
from far_app.what_if import RECORDED, CorrectFlag
from ui.access import Access
from ui.page_server import open_page
from ui.presence import Presence
from ui.why_asking import Asking
from ui.why_link import Link
from ui.why_model import Attribution, Case, attribution, deepest
from ui.why_page import Shown, WhyPage
from ui.why_session import Sitting
from ui.why_state import VERDICTS, Press, fresh, mark_offers, moved, offers

REST, LOOK_AGAIN = 0.3, 1.0
"""Seconds between two looks at the sockets when nothing is pressed, and at the session's folder."""


@dataclass(frozen=True, kw_only=True)
class WhyOptions:
    session: Path
    run_folder: Path
    attempt: Path | None = None
    host: str = "127.0.0.1"
    token: Path | None = None
    """File of what a browser must show; needed on any address but loopback."""
    port: int = 8081
    scene3d: bool = True
    operator: str = "operator"


class View:
    """State of one page: where the operator looks, what is known of it."""

    def __init__(self, options: WhyOptions) -> None:
        self._options = options
        self._sitting = Sitting(options.session)
        access, presence = Access.at(options.host, options.token), Presence()
        self._server = server = open_page(access, options.port, presence)
        self.url = access.url(server.get_port())
        self._page = WhyPage(server, presence, scene3d=options.scene3d)
        self._link = Link(options.run_folder)
        self._asking = Asking(self._link)
        self._said = ""
        self._looked = time.monotonic()
        named = options.attempt.resolve() if options.attempt is not None else None
        at = next((i for i, file in enumerate(self._sitting.files) if file.resolve() == named), None)
        self._open(self._sitting.newest_failure() if at is None else at, chosen=at is not None)

    def close(self) -> None:
        self._link.close()
        self._server.stop()

    def turn(self) -> None:
        """Wait for a press, or a while; then show what is so."""
        try:
            self._pressed(*self._page.events.get(timeout=REST))
            while not self._page.events.empty():
                self._pressed(*self._page.events.get_nowait())
        except queue.Empty:
            pass
        while not self._page.refusals.empty():
            self._said = self._page.refusals.get_nowait()
        self._asking.hear()
        self._refresh()
        self._case = self._read()
        if isinstance(self._case, Case):
            self._found = self._attribute(self._case)
            self._ask()
        with self._server.atomic():
            self._page.show(self._shown())

    # ── what is on show ─────────────────────────────────────────────────────────────────────────────────────────────

    def _open(self, attempt: int, *, chosen: bool) -> None:
        """Another attempt, at its worst chunk."""
        self._looking = fresh(attempt, None, self._sitting.setting)
        self._recorded_case = self._sitting.case(attempt)
        self._shown_case: tuple[object, ...] = ()
        self._found: Attribution | None = None
        self._found_key: tuple[object, ...] = ()
        self._case = self._recorded_case
        if isinstance(self._case, Case):
            self._looking = fresh(attempt, self._case, self._sitting.setting, chosen=chosen)
            self._found = self._attribute(self._case)
            self._looking = replace(self._looking, tick=deepest(self._found))

    def _refresh(self) -> None:
        if time.monotonic() - self._looked < LOOK_AGAIN:
            return
        self._looked = time.monotonic()
        if not self._sitting.refresh():
            return
        newest = self._sitting.newest_failure()
        before = self._recorded_case
        if not self._looking.chosen and newest != self._looking.attempt:
            self._open(newest, chosen=False)
        self._recorded_case = self._sitting.case(self._looking.attempt)
        knew, case = isinstance(before, Case) and before.attributed, self._recorded_case
        if isinstance(case, Case) and case.attributed and not knew and not self._looking.chosen:
            self._open(self._looking.attempt, chosen=False)

    def _read(self) -> Case | str:
        """The recorded case with what was computed for it; the same object while nothing changes."""
        recorded = self._recorded_case
        if not isinstance(recorded, Case):
            return recorded
        contrasts = self._asking.contrasts(self._file, self._looking.choice.critic)
        key = (id(recorded), self._looking.choice.critic, len(contrasts), self._asking.heard)
        if key != self._shown_case:
            self._shown_case = key
            own = recorded.contrasts if self._looking.choice.critic == RECORDED else {}
            self._merged = replace(recorded, contrasts={**own, **contrasts})
        return self._merged

    def _attribute(self, case: Case) -> Attribution:
        words = self._sitting.words(self._looking.attempt)
        values = self._asking.values(self._file, self._looking.choice.critic)
        key = (id(self._recorded_case), self._looking.choice, words, values is None)
        if self._found is None or key != self._found_key:
            self._found_key = key
            return attribution(case, self._looking.choice, words, values)
        return self._found

    @property
    def _file(self) -> str:
        files = self._sitting.files
        index = self._looking.attempt
        return files[index].relative_to(self._sitting.path).as_posix() if 0 <= index < len(files) else ""

    def _ask(self) -> None:
        """Ask for what the chunks on show lack: V under another critic, positives."""
        case, found = self._case, self._found
        if not isinstance(case, Case) or found is None:
            return
        critic = self._looking.choice.critic
        wanted = [self._looking.tick] if self._looking.tick in found.flagged else []
        wanted += [t for t in found.flagged if t not in wanted]
        lacking = tuple(t for t in wanted if t not in case.contrasts and t < case.length - case.horizon)
        values = critic != RECORDED and self._asking.values(self._file, critic) is None
        self._asking.want(self._file, critic, lacking, values)

    def _shown(self) -> Shown:
        sitting, looking = self._sitting, self._looking
        case, found = (self._case, self._found) if isinstance(self._case, Case) else (None, None)
        lesson = self._asking.lesson(self._file, looking.choice.critic)
        pair = next(((m.before, m.after) for m in lesson.moved if m.tick == looking.tick), None) if lesson else None
        note = self._asking.note(self._file, looking.choice.critic)
        if found is not None and looking.tick not in found.flagged:
            note = "better chunks are drawn for flagged ones"
        answerer = self._link.answerer
        problems = (*(case.problems if case is not None else ()), *sitting.problems)
        judged, nobody = sitting.judgment(looking.attempt), self._link.cannot_correct
        running = "it still runs: mark on its page" if sitting.session.live and self._link.critics else ""
        return Shown(
            looking=looking, case=case, found=found, attempts=len(sitting.files), scale=sitting.setting.scale,
            offers=offers(
                looking, case, found, attempts=len(sitting.files), critics=self._link.critics,
                can_correct=nobody, adapting=self._asking.adapting,
            ) | mark_offers(judged, nobody or running, self._page.marks.note),
            place=sitting.place(looking.attempt) if sitting.files else None, judged=judged,
            marks=sitting.marks(looking.attempt),
            unreadable=self._case if isinstance(self._case, str) else "", note=note, lesson=lesson, moved=pair,
            moved_words=_moved_words(pair, sitting.setting.scale) if pair else "",
            session=sitting.session.header.session, problems=problems,
            said=self._said or (answerer.said if answerer is not None else ""),
        )  # fmt: skip

    # ── what is pressed ─────────────────────────────────────────────────────────────────────────────────────────────

    def _pressed(self, press: Press, value: float) -> None:
        """The guard is here: a raw client may press anything at any time."""
        case = self._case if isinstance(self._case, Case) else None
        offer = self._shown().offers.get(press)
        if offer is not None and not offer.enabled:
            self._said = f"{press.value.replace('_', ' ')} is refused: {offer.line}"
            return
        self._said = ""
        if press in (Press.ATTEMPT_NEXT, Press.ATTEMPT_PREVIOUS):
            self._open(self._looking.attempt + (1 if press is Press.ATTEMPT_NEXT else -1), chosen=True)
        elif press in VERDICTS or press is Press.KEEP_NOTE:
            self._mark(press)
        elif case is None or self._found is None:
            return
        elif press is Press.RESET:
            tick = self._looking.tick
            self._looking = replace(fresh(self._looking.attempt, case, self._sitting.setting, chosen=True), tick=tick)
        elif press is Press.CORRECT:
            self._correct(self._found)
        elif press is Press.ADAPT:
            self._asking.adapt(self._file, self._looking.choice.critic, self._found.flagged)
        else:
            self._looking = replace(
                moved(self._looking, press, value, case, self._found, self._link.critics), chosen=True
            )
        if isinstance(self._case, Case):
            self._found = self._attribute(self._case)

    def _correct(self, found: Attribution) -> None:
        trial, attempt = self._sitting.place(self._looking.attempt)
        tick = self._looking.tick
        correction = FlagCorrection(
            tick=tick, flagged=tick not in found.flagged, by=self._options.operator, wall=wall_clock()
        )
        session = self._sitting.session.header.session
        self._tell(CorrectFlag(session=session, trial=trial, attempt=attempt, correction=correction), "correction")

    def _mark(self, press: Press) -> None:
        """A verdict or a note on the attempt on show, which stays on show."""
        self._looking = replace(self._looking, chosen=True)
        trial, attempt = self._sitting.place(self._looking.attempt)
        note = self._page.marks.take_note() if press is Press.KEEP_NOTE else ""
        mark = Mark(
            trial=trial, attempt=attempt, verdict=VERDICTS.get(press), note=note, by=self._options.operator,
            wall=wall_clock(),
        )  # fmt: skip
        self._tell(MarkAttempt(session=self._sitting.session.header.session, mark=mark), "mark")

    def _tell(self, word: CorrectFlag | MarkAttempt, what: str) -> None:
        if not self._link.send(word):
            self._said = f"nobody took the {what}: is far replay (or far run) still running?"
        self._looked = 0.0


def _moved_words(pair: tuple[np.ndarray, np.ndarray], scale: float) -> str:
    """How far the ends of the sampled chunks moved."""
    before, after = (scale * np.asarray(chunks)[..., :3].sum(axis=1) for chunks in pair)
    apart = 1000 * np.linalg.norm(after - before, axis=1)
    return f"moved {apart.mean():.1f} mm, grey → violet"
