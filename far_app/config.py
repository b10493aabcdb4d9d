"""Settings of the method, frozen, each with its unit and source. The resolved configuration is saved with every run."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar, get_type_hints

from far_app.errors import ConfigError

T = TypeVar("T")

Arm = Literal["xarm7", "panda"]


def from_table(cls: type[T], table: Mapping[str, Any], where: str, base: T | None = None) -> T:
    """Settings from a TOML table, nested as the dataclasses are; what is not given keeps its default, or what `base`
    has there. Raises ConfigError that names the place and what is known there."""
    fields = [f.name for f in dataclasses.fields(cls)]  # type: ignore[arg-type]
    unknown = sorted(set(table) - set(fields))
    if unknown:
        raise ConfigError(f"{where}: unknown setting {', '.join(unknown)}; known: {', '.join(fields)}")
    kinds, values = get_type_hints(cls), {}
    for key, value in table.items():
        if dataclasses.is_dataclass(kinds[key]) != isinstance(value, dict):
            expected = "a value" if isinstance(value, dict) else "a table"
            raise ConfigError(f"{where}.{key} is {value!r}, must be {expected}")
        if isinstance(value, dict):
            values[key] = from_table(kinds[key], value, f"{where}.{key}", getattr(base, key) if base else None)
        else:
            values[key] = tuple(value) if isinstance(value, list) else value
    try:
        return cls(**values) if base is None else dataclasses.replace(base, **values)  # type: ignore[type-var]
    except TypeError as error:
        raise ConfigError(f"{where}: {error}") from error


def _check(ok: bool, what: str, value: object, limit: str) -> None:
    if not ok:
        raise ConfigError(f"{what} is {value}, must be {limit}")


@dataclass(frozen=True, kw_only=True)
class AttributionConfig:
    """Which chunks are to blame (paper, Failure Attribution)."""

    rule: Literal["percentile", "threshold", "whole"] = "percentile"
    """percentile is the paper's; threshold and whole are its ablations."""
    rho: float = 10.0
    """ρ, per cent of the attempt's whole chunks (paper, hyperparameter table)."""
    threshold: float = float("nan")
    """ΔV below which a chunk is flagged when rule is threshold; where it is not given, the 5th percentile of the
    demonstrations' own ΔV, as the critic's card tells it (the paper tells no threshold)."""

    def __post_init__(self) -> None:
        _check(0 < self.rho <= 100, "attribution.rho", self.rho, "in (0, 100]")


@dataclass(frozen=True, kw_only=True)
class PairsConfig:
    """Positives for each flagged chunk (paper, Contrastive Sample Construction)."""

    candidates: int = 64
    """M (paper, hyperparameter table)."""
    positives: int = 8
    """K (paper, hyperparameter table)."""
    d_min: float | Literal["mean"] = "mean"
    """Smallest L2 distance to the negative; "mean" is the mean over the state's candidates (paper)."""
    d_max: float = 1.0
    """Largest L2 distance (paper, hyperparameter table)."""
    arm_only: bool = True
    """Leave the gripper dimension out of d(·,·) (one flipped gripper tick alone would add 2.0)."""
    on_empty: Literal["drop_d_max", "skip"] = "drop_d_max"
    """What to do with a state whose filtered set is empty; both are counted."""
    explore: float = 0.0
    """σ of the constant translation added to each candidate, action units; 0 is the paper. A policy that is sure of its
    mistake samples nothing better: a retry is perturbed anyway, and Q can say which perturbation would have helped."""
    choose: Literal["critic", "random"] = "critic"
    """TopK by Q, or the paper's random ablation."""

    def __post_init__(self) -> None:
        _check(self.candidates >= 1, "pairs.candidates", self.candidates, "at least 1")
        _check(1 <= self.positives <= self.candidates, "pairs.positives", self.positives, f"1 to {self.candidates}")
        _check(self.d_max > 0, "pairs.d_max", self.d_max, "above 0")
        _check(self.explore >= 0, "pairs.explore", self.explore, "at least 0")


@dataclass(frozen=True, kw_only=True)
class FCPAConfig:
    """The preference update (paper, Failure-Contrastive Preference Adaptation)."""

    objective: Literal["pairwise", "no_positive", "no_negative", "awr"] = "pairwise"
    beta: float = 0.1
    """β (paper, hyperparameter table)."""
    steps: int = 10
    """Gradient steps (paper, hyperparameter table)."""
    lr: float = 1e-5
    """AdamW's step size (paper, hyperparameter table); no weight decay."""
    draws: int = 2
    """(k, ε) draws a step, shared by a state's negative and its positives; k stratified."""
    reduction: Literal["sum", "mean"] = "sum"
    """Squared error summed over the chunk's entries, as Eq. l_diff reads, or averaged."""
    arm_only: bool = False
    """Leave the gripper out of l_diff. With it (the paper), a failure in which the hand closed beside the object
    teaches the policy not to close at all."""
    guard: Literal["none", "stop", "scale", "bc"] = "none"
    """none is the paper; stop ends the update when l⁺ on fixed draws has risen by guard_rise; scale shrinks the
    loser's gradient so that l⁺ cannot rise to first order; bc adds a behaviour-cloning term on demonstrations."""
    guard_rise: float = 0.05
    """Relative rise of l⁺ that ends the update when guard is stop or scale."""
    bc_weight: float = 1.0
    """Weight of the behaviour-cloning term when guard is bc."""
    accumulate: bool = True
    """Start from the trial's adapted weights (paper, Algorithm 1); False restarts from the base with all of the
    trial's pairs."""
    hedge: bool = False
    """Every other retry acts with the base policy (False is the paper): a retry that failed for all it had learnt is
    evidence against the lesson, and where failures are chance a plain second try is the better one. A bad lesson then
    costs one attempt and not the trial. Needs accumulate = false."""

    def __post_init__(self) -> None:
        _check(self.steps >= 0, "fcpa.steps", self.steps, "at least 0")
        _check(self.lr > 0, "fcpa.lr", self.lr, "above 0")
        _check(self.draws >= 1, "fcpa.draws", self.draws, "at least 1")
        _check(
            not (self.hedge and self.accumulate), "fcpa.accumulate", self.accumulate, "false when fcpa.hedge is true"
        )


@dataclass(frozen=True, kw_only=True)
class PerturbationConfig:
    """Exploration on retries (paper, Perturbation for Retry Exploration). The gripper is never perturbed."""

    kind: Literal["none", "gaussian", "smoothed"] = "gaussian"
    """Plain Gaussian in simulation, smoothed on hardware (paper)."""
    probability: float = 0.5
    """ε_explore (paper, hyperparameter table)."""
    adaptive: bool = False
    """Use 0.3 + 0.1 k at retry k instead of probability (the paper's adaptive ablation)."""
    sigma: float = 0.1
    """σ in action units (paper, hyperparameter table)."""
    alpha: float = 0.3
    """α, smoothing coefficient (paper, hyperparameter table)."""
    hold: int = 5
    """h, ticks for which a smoothed target is kept."""
    dims: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    """Perturbed action dimensions; (0, 1, 2) on hardware (paper, Real-world Experiments)."""
    first_attempt: int = 2
    """Attempts from this one on are perturbed (paper: the retries)."""

    def __post_init__(self) -> None:
        _check(0 <= self.probability <= 1, "perturbation.probability", self.probability, "in [0, 1]")
        _check(self.sigma >= 0, "perturbation.sigma", self.sigma, "at least 0")
        _check(0 <= self.alpha < 1, "perturbation.alpha", self.alpha, "in [0, 1)")
        _check(all(0 <= d < 6 for d in self.dims), "perturbation.dims", self.dims, "arm dimensions 0 to 5")


@dataclass(frozen=True, kw_only=True)
class ResamplingConfig:
    """Retries that choose among samples (bgr; beyond the paper rerank, fcpa-rerank and negative-guidance)."""

    samples: int = 16
    """N, chunks drawn where a choice is made (paper, Baselines: 16 for DP-BGR)."""
    radius_percentile: float = 10.0
    """How near a state must be to a failed one: this percentile of the distances between the demonstrations' states
    and their nearest others, in feature space (the paper tells no threshold; a low percentile is our choice)."""
    repulsion: float = 0.3
    """w of negative-guidance: how far each denoising step is pushed from the failed chunk, action units over the whole
    chunk."""

    def __post_init__(self) -> None:
        _check(self.samples >= 1, "resampling.samples", self.samples, "at least 1")
        _check(0 < self.radius_percentile <= 100, "resampling.radius_percentile", self.radius_percentile, "in (0, 100]")
        _check(self.repulsion >= 0, "resampling.repulsion", self.repulsion, "at least 0")


@dataclass(frozen=True, kw_only=True)
class RetryConfig:
    """One method of retrying, whole."""

    attribution: AttributionConfig = field(default_factory=AttributionConfig)
    pairs: PairsConfig = field(default_factory=PairsConfig)
    fcpa: FCPAConfig = field(default_factory=FCPAConfig)
    perturbation: PerturbationConfig = field(default_factory=PerturbationConfig)
    resampling: ResamplingConfig = field(default_factory=ResamplingConfig)
    adaptation_limit: float = 60.0
    """Seconds after which a retry no longer waits for its adaptation."""


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """A task is one entry of data (far_app/tasks.py)."""

    name: str
    environment: str
    """robosuite's name."""
    horizon: int
    """Policy ticks an attempt may take."""
    repeat: int = 1
    """Control steps for which a policy's action is repeated within its tick (paper, Simulation: 3 for some tasks)."""
    objects: tuple[tuple[str, str], ...] = ()
    """What the twin tells of the scene: a name for people and policies, and MuJoCo's body or site."""
    success_ticks: int = 5
    """Consecutive ticks for which the twin's own check must hold."""
    max_attempts: int = 5
    """N (paper: 5 in simulation, 3 on the real arm)."""
    judge: Literal["twin", "person"] = "twin"
    """Who says that it succeeded where no learned detector does: the twin's own check, or a person (paper, Real-world
    Experiments: by human inspection)."""
    rate: float = 30.0
    """Policy ticks a second."""
    placement: tuple[float, float] | None = None
    """Half-width of the objects' start region in x and y, metres; robosuite's own where it is None."""
    release: Literal["open", "lower_then_open", "ask"] = "open"
    """How to let go before homing."""
    retreat: tuple[float, float, float] = (0.0, 0.0, 0.10)
    """Retreat before the path home, metres, base frame."""
    path: tuple[tuple[float, float, float], ...] = ()
    """Points to pass through after the retreat, in this order, metres from the start pose, base frame: for a task with
    something in the straight way home. Empty: straight."""
    cameras: tuple[str, ...] = ("front", "wrist")
    front: tuple[tuple[float, float, float], tuple[float, float, float]] = ((0.62, 0.0, 1.42), (-0.03, 0.0, 0.93))
    """Where the twin's front camera stands and what it looks at, metres, in the twin's world."""
