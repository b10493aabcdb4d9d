"""After a demonstration: the arm is held until the operator keeps it, discards it or wants it recorded again."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from far_app.session.operator import Operator
from far_app.session.standing import Standing
from far_app.session.supervision import Supervision, TrialAbandoned
from far_app.session_states import Happening, Intent, State
from far_app.types import Attempt, Judge, Outcome

Keep = Callable[[Attempt], None]
"""Takes a demonstration that the operator keeps. Raises FarError where it cannot be kept."""


def drop(attempt: Attempt) -> None:
    """A Keep that keeps nothing."""


class Review:
    def __init__(self, standing: Standing, supervision: Supervision, operator: Operator, keep: Keep) -> None:
        self.standing, self.supervision, self.operator, self._keep = standing, supervision, operator, keep

    def ask(self, attempt: Attempt, kept: int, wanted: int) -> Intent:
        """KEEP, DISCARD or RECORD_AGAIN; `kept` of `wanted` (0: no end) are there already. Raises TrialAbandoned when
        the session was ended instead."""
        standing, trial = self.standing, self.standing.board.trial
        seconds = attempt.steps[-1].stamp - attempt.steps[0].stamp if attempt.steps else 0.0
        count = f"{kept} of {wanted} kept" if wanted else f"{kept} kept"
        standing.hold("a demonstration is reviewed")
        while True:
            if standing.state in (State.TRIAL_DONE, State.READY):
                standing.happen(Happening.NEED_REVIEW)
            success = self._success(trial, attempt)
            standing.withheld[Intent.KEEP] = "" if success else "it is no success: mark it one first, or discard it"
            word = "success" if success else "no success"
            standing.board.reason = f"{word}, {seconds:.1f} s ({count}): keep it, discard it, or record it again?"
            standing.show()
            time.sleep(self.supervision.clock.period)
            said = self._word()
            if said is Intent.KEEP:
                judged = attempt.outcome if attempt.outcome.success else _by_a_person()
                self._keep(replace(attempt, outcome=judged))
            if said is not None:
                standing.recorder.event("demonstration", said.value, {"trial": trial, "ticks": len(attempt.steps)})
                return said
            if standing.state is State.FINISHED:
                raise TrialAbandoned

    def _word(self) -> Intent | None:
        """What was said since the last look, if it settles the matter."""
        self.supervision.attend_between()
        for intent in self.operator.inbox.drain():
            asked = self.standing.state
            self.operator.ask(intent, "between")
            if asked is State.REVIEWING and self.standing.state is State.TRIAL_DONE:
                return intent
        self.operator.listen()
        self.supervision.rest("between")
        return None

    def _success(self, trial: int, attempt: Attempt) -> bool:
        """By the last word on it: the marks of the page are a way to correct the program's judgment."""
        judged = self.standing.board.history.of(trial, attempt.index)
        return bool(judged.final) if judged is not None else attempt.outcome.success


def _by_a_person() -> Outcome:
    return Outcome(success=True, judged_by=Judge.OPERATOR, note="marked a success when it was kept")
