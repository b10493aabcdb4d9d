"""What the page and the terminal are told of a plan: wire values, numpy only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from far_app.wire import register


@register
@dataclass(frozen=True, kw_only=True)
class ArmShown:
    """One side of the comparison, under the name the operator may know."""

    label: str
    trials: int
    """Done."""
    solved: tuple[int, ...]
    """Within 1, 2, … attempts."""
    low: tuple[float, ...]
    """95 % Wilson bounds of each, in [0, 1]."""
    high: tuple[float, ...]


@register
@dataclass(frozen=True, kw_only=True)
class DifferenceShown:
    """Left − right on the same scenes, each within its own attempts; points in [−1, 1]."""

    left: str
    right: str
    pairs: int
    mean: float
    low: float
    high: float
    only_left: int
    only_right: int
    p: float
    """Exact McNemar, two-sided."""
    left_to_go: int | None
    """Trials until the interval is as narrow as wished, as far as one can tell; None before the first pair."""


@register
@dataclass(frozen=True, kw_only=True)
class PlanShown:
    name: str
    done: int
    total: int
    blind: bool
    """The methods are told by letters until the plan is done."""
    label: str = ""
    """Of the trial under way or about to begin."""
    scene: str = ""
    repetition: int = 0
    repetitions: int = 1
    precision: float = 10.0
    """± points that are wished for."""
    arms: tuple[ArmShown, ...] = ()
    differences: tuple[DifferenceShown, ...] = ()
    revealed: tuple[tuple[str, str], ...] = ()
    """Letter and method, once a blinded plan is done."""


@register
@dataclass(frozen=True, kw_only=True)
class SceneShown:
    """A real scene that is being rebuilt."""

    name: str
    reference: Mapping[str, bytes] = field(default_factory=dict)
    """Camera to PNG of how it is to look; empty where this trial's own start will be kept."""
    scores: Mapping[str, float] = field(default_factory=dict)
    """Camera to match, 0 to 1."""
    limit: float = 0.8

    @property
    def score(self) -> float | None:
        """The worst camera's."""
        return min(self.scores.values(), default=None)
