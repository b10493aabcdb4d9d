"""What the attempt view has asked the app and heard of it: values by critic, positives, the latest adapt-again."""

from __future__ import annotations

import itertools
import time

from far_app.types import Contrast
from far_app.what_if import Answer, Question
from ui.why_link import Link

SETTLE = 0.4
"""Seconds a wish must stay the same before it becomes a question: a slider passes many."""
PATIENCE = 60.0
"""Seconds without a word after which a question counts as lost."""

Key = tuple[str, str]
"""An attempt's file and a critic."""


class Asking:
    """One question at a time; an adapt-again is not interrupted by lesser ones."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._number = itertools.count(1 + int(time.monotonic()) % 1_000_000)
        self._wish: tuple[object, ...] = ()
        self._wished = self._spoke = 0.0
        self._open: Question | None = None
        self._failed: dict[tuple[object, ...], str] = {}
        self._values: dict[Key, Answer] = {}
        self._contrasts: dict[Key, dict[int, Contrast]] = {}
        self._none: dict[Key, set[int]] = {}
        """Chunks asked for that have no positive."""
        self._lessons: dict[Key, Answer] = {}
        self._stage = ""
        self.heard = 0
        """Counts answers: what depends on them is made anew."""

    @property
    def adapting(self) -> bool:
        return self._open is not None and self._open.adapt

    def hear(self) -> None:
        for answer in self._link.poll():
            question = self._open
            if question is None or answer.number != question.number:
                continue
            self._spoke = time.monotonic()
            self._take(question, answer)
        if self._open is not None and time.monotonic() - self._spoke > PATIENCE:
            self._open, self._stage = None, ""

    def _take(self, question: Question, answer: Answer) -> None:
        key = (answer.file, answer.critic)
        self.heard += 1
        self._stage = answer.stage
        if len(answer.values):
            self._values[key] = answer
        self._contrasts.setdefault(key, {}).update({c.tick: c for c in answer.contrasts})
        if question.adapt:
            self._lessons[key] = answer
        if answer.stage:
            return
        self._open = None
        self._none.setdefault(key, set()).update(set(question.ticks) - set(self._contrasts[key]))
        if answer.error:
            self._failed[key] = answer.error

    def want(self, file: str, critic: str, ticks: tuple[int, ...], values: bool) -> None:
        """What the page lacks now; asked once it has lasted a moment."""
        key = (file, critic)
        ticks = tuple(t for t in ticks if t not in self._none.get(key, ()))
        if critic not in self._link.critics or not (ticks or values) or key in self._failed or self.adapting:
            return
        wish = (file, critic, ticks, values)
        now = time.monotonic()
        if wish != self._wish:
            self._wish, self._wished = wish, now
        underway = self._open is not None and self._covers(self._open, wish)
        if not underway and now - self._wished >= SETTLE:
            self._ask(Question(number=next(self._number), file=file, critic=critic, ticks=ticks))

    def _covers(self, question: Question, wish: tuple[object, ...]) -> bool:
        file, critic, ticks, _ = wish
        assert isinstance(ticks, tuple)
        return (question.file, question.critic) == (file, critic) and set(ticks) <= set(question.ticks)

    def adapt(self, file: str, critic: str, ticks: tuple[int, ...]) -> None:
        """Learn from these chunks once more."""
        self._failed.pop((file, critic), None)
        self._ask(Question(number=next(self._number), file=file, critic=critic, ticks=ticks, adapt=True))

    def _ask(self, question: Question) -> None:
        if self._link.send(question):
            self._open, self._spoke, self._stage = question, time.monotonic(), "asked"
            if question.adapt:
                key = (question.file, question.critic)
                self._lessons[key] = Answer(
                    number=question.number, file=question.file, critic=question.critic, stage="asked"
                )

    def values(self, file: str, critic: str) -> Answer | None:
        return self._values.get((file, critic))

    def contrasts(self, file: str, critic: str) -> dict[int, Contrast]:
        return self._contrasts.get((file, critic), {})

    def lesson(self, file: str, critic: str) -> Answer | None:
        return self._lessons.get((file, critic))

    def note(self, file: str, critic: str) -> str:
        """What to know about the positives: under way, failed, or computed with another policy."""
        if (file, critic) in self._failed:
            return self._failed[file, critic]
        if self._open is not None and (self._open.file, self._open.critic) == (file, critic):
            return f"{self._stage or 'asked'} …"
        answer = self._values.get((file, critic))
        return answer.note if answer is not None else ""
