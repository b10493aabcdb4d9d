"""Who says that an attempt is over: the twin's own check, held long enough, or a person; and above both the operator.

A learned detector: far_app/learning/success.py.

The horizon and a latched arm end an attempt in far_app/attempt.py itself.
"""

from __future__ import annotations

from far_app.protocols import SuccessDetector
from far_app.types import Judge, Observation, Outcome


class TwinCheck:
    """Success once the twin's own check has held for `ticks` consecutive ticks."""

    patience = 0.0

    def __init__(self, ticks: int = 5) -> None:
        self.ticks = ticks
        self._held = 0

    def begin(self) -> None:
        self._held = 0

    def judge(self, observation: Observation) -> Outcome | None:
        """Counts ticks on which observation.success is true; one miss starts over."""
        self._held = self._held + 1 if observation.success else 0
        return Outcome(success=True, judged_by=Judge.TWIN) if self._held >= self.ticks else None


class PersonJudge:
    """Says nothing itself: a person marks the success, at the latest `patience` seconds after the horizon."""

    def __init__(self, patience: float) -> None:
        self.patience = patience

    def begin(self) -> None: ...

    def judge(self, observation: Observation) -> Outcome | None:
        return None


class OperatorOverride:
    """The operator's word (or the session's own, on a fault) ends the attempt before any detector is asked."""

    def __init__(self, detector: SuccessDetector) -> None:
        self.detector = detector
        self._word: Outcome | None = None

    @property
    def patience(self) -> float:
        return self.detector.patience

    def rule(self, outcome: Outcome) -> None:
        """The next judgement of this attempt is `outcome`; the first word stands."""
        if self._word is None:
            self._word = outcome

    def begin(self) -> None:
        self._word = None
        self.detector.begin()

    def judge(self, observation: Observation) -> Outcome | None:
        return self._word or self.detector.judge(observation)
