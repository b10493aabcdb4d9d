"""Which trial comes next: the same method on one scene after the other, or whatever a plan says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from far_app.protocols import Method
from far_app.recording.scene_file import SceneAccepted
from far_app.session.settings import TrialResult
from far_app.session_states import Intent
from far_app.trial_plan.shown import PlanShown, SceneShown
from far_app.types import Observation


class Gate(Protocol):
    """A real scene that is being rebuilt before its trial."""

    def look(self, observation: Observation) -> SceneShown:
        """How it matches now, for the page."""
        ...

    def refusal(self, observation: Observation) -> str:
        """Why the operator's Scene ready is not taken; "" when it is."""
        ...

    def accepted(self, observation: Observation) -> SceneAccepted:
        """What the recording keeps of it."""
        ...


@dataclass(frozen=True, kw_only=True)
class Assignment:
    """One trial to run."""

    seed: int
    """Of the scene."""
    method: Method
    label: str
    """What the operator is told of the method: its name, or a letter."""
    chance: int | None = None
    """Key of noise and perturbation; the scene's seed by default."""
    max_attempts: int | None = None
    """The task's by default."""
    blind: bool = False
    """Nothing that the operator is told may give the method away."""
    gate: Gate | None = None
    record: Mapping[str, Any] = field(default_factory=dict)
    """The truth, for the recording."""


class Course(Protocol):
    fixed: str
    """Why the operator may not choose the policy's versions; "" when they may."""

    def next(self) -> Assignment | None:
        """The trial to run; None when there is no more. Asked while the arm stands."""
        ...

    def ended(self, assignment: Assignment, result: TrialResult) -> None:
        """What became of it."""
        ...

    def shown(self) -> PlanShown | None:
        """A plan's state, for the page; None where there is no plan."""
        ...


class Consecutive:
    """The next seed each time, under one method."""

    fixed = ""

    def __init__(self, method: Method, *, seed: int, trials: int) -> None:
        """`trials` 0: without end."""
        self._method, self._seed = method, seed
        self._left: float = trials or float("inf")

    def next(self) -> Assignment | None:
        if self._left <= 0:
            return None
        self._left -= 1
        self._seed += 1
        return Assignment(seed=self._seed - 1, method=self._method, label=self._method.name)

    def ended(self, assignment: Assignment, result: TrialResult) -> None: ...

    def shown(self) -> PlanShown | None:
        return None


class Demonstrations:
    """One seed after the other until so many demonstrations are kept; what is recorded again keeps its scene."""

    fixed = ""

    def __init__(self, method: Method, *, seed: int, trials: int) -> None:
        """`trials` 0: without end."""
        self._method, self._seed, self._trials = method, seed, trials
        self.kept = 0

    def next(self) -> Assignment | None:
        if self._trials and self.kept == self._trials:
            return None
        return Assignment(seed=self._seed, method=self._method, label=self._method.name)

    def ended(self, assignment: Assignment, result: TrialResult) -> None:
        self.kept += result.word is Intent.KEEP
        self._seed += result.word is not Intent.RECORD_AGAIN

    def shown(self) -> PlanShown | None:
        return None
