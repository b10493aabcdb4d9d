"""A plan of trials as data: what is compared, on which scenes, how often. Read from TOML, refused before any motion.

    name, task, seed, repetitions, blind, max_attempts, precision, match
    seeds = [1000, 1001] or { first = 1000, count = 20 }     the twin's scenes
    [[scene]]    name, and image + camera, or recording + trial, or neither      a real arm's
    [[method]]   name, method, policy, critic, settings, retry

Every error names the file, the key, its value and what is allowed. Pure but for looking whether files are there.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from far_app.evaluation import identity

MOST_REPETITIONS = 100
MOST_TRIALS = 10_000
MOST_ATTEMPTS = 50
SEEDS = 2**31
"""Scene seeds lie below."""
CHANCE = 2**32
"""Added to a scene's seed with each repetition: the same scene, other draws of noise and perturbation."""


@dataclass(frozen=True, kw_only=True)
class PlannedMethod:
    """One side of the comparison."""

    name: str
    method: str
    """One of far_app.methods.METHODS."""
    policy: str | None = None
    """Checkpoint; the shipped model's by default."""
    critic: Path | None = None
    settings: str = "model"
    """Where settings of retrying begin: "model" (beside the checkpoint) or "paper"."""
    retry: Mapping[str, Any] = field(default_factory=dict)
    """What differs from them, nested as RetryConfig is."""

    def record(self) -> dict[str, Any]:
        """What makes its results what they are; checkpoints by content."""
        return {
            "name": self.name, "method": self.method, "policy": identity(self.policy) if self.policy else "shipped",
            "critic": identity(str(self.critic)) if self.critic else "", "settings": self.settings,
            "retry": dict(self.retry),
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Scene:
    """How a trial begins: a seed (twin), or a real scene by its name and what it is to look like."""

    name: str
    seed: int
    """Twin: the scene itself. Real arm: its place in the plan, which keys noise and perturbation."""
    images: Mapping[str, Path] = field(default_factory=dict)
    """Camera to picture file."""
    recording: Path | None = None
    """A session's folder whose `trial` began as this scene is to look."""
    trial: int = 0

    @property
    def source(self) -> str:
        """Where its look comes from; "" where the first trial's own start is kept."""
        if self.recording is not None:
            return f"{self.recording.name} trial {self.trial}"
        return ", ".join(f"{camera}: {identity(str(path))}" for camera, path in sorted(self.images.items()))


@dataclass(frozen=True, kw_only=True)
class TrialPlan:
    file: Path
    name: str
    task: str
    robot: str
    """"twin" or "xarm"."""
    methods: tuple[PlannedMethod, ...]
    scenes: tuple[Scene, ...]
    repetitions: int = 1
    seed: int = 0
    """Of the order, and of the letters of a blinded plan."""
    blind: bool = False
    """The page and the terminal tell the methods by letters until all trials are done."""
    max_attempts: int | None = None
    precision: float = 10.0
    """± points of the paired difference's 95 % interval that are wished for."""
    match: float = 0.8
    """Score below which a rebuilt scene must be accepted twice."""

    @property
    def trials(self) -> int:
        return len(self.methods) * len(self.scenes) * self.repetitions

    def record(self) -> dict[str, Any]:
        """For the recording's configuration."""
        return {
            "name": self.name, "task": self.task, "robot": self.robot, "seed": self.seed, "blind": self.blind,
            "max_attempts": self.max_attempts, "repetitions": self.repetitions, "precision": self.precision,
            "match": self.match, "methods": [method.record() for method in self.methods],
            "scenes": [{"name": s.name, "seed": s.seed, "source": s.source} for s in self.scenes],
        }  # fmt: skip


def recorded(record: Mapping[str, Any], *, blind: bool) -> TrialPlan:
    """A plan as a recording has it, as far as its order, its letters and its figures need it."""
    return TrialPlan(
        file=Path(), name=str(record["name"]), task=str(record["task"]), robot=str(record["robot"]),
        methods=tuple(PlannedMethod(name=m["name"], method=m["method"]) for m in record["methods"]),
        scenes=tuple(Scene(name=s["name"], seed=int(s["seed"])) for s in record["scenes"]),
        repetitions=int(record["repetitions"]), seed=int(record["seed"]), blind=blind,
        precision=float(record["precision"]),
    )  # fmt: skip


def changed(plan: TrialPlan, before: Mapping[str, Any]) -> list[str]:
    """Keys in which a plan differs from a recorded one so that their trials cannot be counted together. Scenes and
    repetitions may be added; precision, match and blinding say nothing of a trial."""
    now = plan.record()
    keys = [k for k in ("task", "robot", "seed", "max_attempts", "methods") if now[k] != before.get(k)]
    known = {s["name"]: s for s in before.get("scenes", ())}
    return keys + [f"scene '{s['name']}'" for s in now["scenes"] if known.get(s["name"], s) != s]


def valid_name(word: str) -> bool:
    """Usable in a folder's name, on a page and in a command."""
    return re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._+ -]{0,39}", word) is not None


def chance(scene: Scene, repetition: int) -> int:
    """Key of a trial's noise and perturbation: the same for every method, another for each repetition (1-based)."""
    return scene.seed + CHANCE * (repetition - 1)


def seeded(seeds: Sequence[int]) -> tuple[Scene, ...]:
    """The twin's scenes."""
    return tuple(Scene(name=f"seed {seed}", seed=seed) for seed in seeds)
