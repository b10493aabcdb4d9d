"""The trials and attempts so far as the page lists them: the program's judgment, and people's words beside it."""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import replace

from far_app.marks import Judged, Mark
from far_app.telemetry import TrialRow
from far_app.types import Attempt

TRIALS, ATTEMPTS = 200, 300
"""Rows that are kept for the page."""


class History:
    """Filled and read by the loop's thread only."""

    def __init__(self) -> None:
        self._trials = deque[TrialRow](maxlen=TRIALS)
        self._attempts: OrderedDict[tuple[int, int], Judged] = OrderedDict()
        self._early: dict[tuple[int, int], list[Mark]] = {}
        """Words on the attempt under way."""
        self._trials_told: tuple[TrialRow, ...] | None = ()
        self._attempts_told: tuple[Judged, ...] | None = ()
        """What the loop hands to the page many times a second; made anew after a change only."""

    @property
    def trials(self) -> tuple[TrialRow, ...]:
        """Under the last word on each attempt."""
        if self._trials_told is None:
            self._trials_told = tuple(self._told(row) for row in self._trials)
        return self._trials_told

    @property
    def attempts(self) -> tuple[Judged, ...]:
        if self._attempts_told is None:
            self._attempts_told = tuple(self._attempts.values())
        return self._attempts_told

    def has(self, trial: int, attempt: int) -> bool:
        return (trial, attempt) in self._attempts

    def of(self, trial: int, attempt: int) -> Judged | None:
        return self._attempts.get((trial, attempt))

    def attempt_ended(self, trial: int, attempt: Attempt) -> None:
        key, outcome = (trial, attempt.index), attempt.outcome
        self._attempts[key] = Judged(
            trial=trial, attempt=attempt.index, success=outcome.success, judged_by=outcome.judged_by.value,
            policy_version=attempt.policy_version,
        )  # fmt: skip
        self._changed()
        for mark in self._early.pop(key, []):
            self.marked(mark)
        while len(self._attempts) > ATTEMPTS:
            self._attempts.popitem(last=False)

    def trial_ended(self, row: TrialRow) -> None:
        self._trials.append(row)
        self._changed()
        self._early.clear()

    def marked(self, mark: Mark) -> None:
        """A word on an attempt that ended, or is under way."""
        key = mark.trial, mark.attempt
        before = self._attempts.get(key)
        if before is None:
            self._early.setdefault(key, []).append(mark)
            return
        verdict = mark.verdict if mark.verdict is not None else before.verdict
        self._attempts[key] = replace(before, verdict=verdict, note=mark.note or before.note, by=mark.by or before.by)
        self._changed()

    def _changed(self) -> None:
        self._trials_told = self._attempts_told = None

    def _told(self, row: TrialRow) -> TrialRow:
        said = [a for a in self._attempts.values() if a.trial == row.trial and a.verdict is not None]
        if not said:
            return row
        of_trial = [a for a in self._attempts.values() if a.trial == row.trial]
        unsure = any(a.final is None for a in of_trial)
        success = any(a.final for a in of_trial)
        note = f"{'unsure' if unsure else 'success' if success else 'failure'} by {said[-1].by or 'a person'}"
        return replace(
            row, success=success, counted=row.counted and not unsure,
            judged_by=f"{row.judged_by}, marked" if success == row.success else f"{row.judged_by}, corrected",
            note="; ".join(part for part in (note, row.note) if part),
        )  # fmt: skip
