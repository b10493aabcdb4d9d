"""Continual policy improvement as data (paper, the section of that name): what an epoch does, and what was found.

Pure: far_app/cli/improve.py runs it, far_app/learning/improve.py learns.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from far_app.config import PerturbationConfig
from far_app.errors import ConfigError
from far_app.perturbation import Perturbation, perturbation
from far_app.protocols import Method, Policy, Progress
from far_app.types import Adaptation, Attempt

COLLECT_SCENES = 40_000
"""Scene seeds for collecting; never evaluated on."""
SCENES_A_SEED = 1_000

Collector = Literal["dp", "nr", "far"]
RewardKind = Literal["shaped", "sparse", "real"]


@dataclass(frozen=True, kw_only=True)
class Improvement:
    """The loop's settings; defaults are the paper's."""

    epochs: int = 15
    episodes: int = 20
    """Collected in an epoch, each from its own scene."""
    noise: float = 0.1
    """σ of the Gaussian noise on every action while collecting, action units."""
    attempts: int = 5
    """Per episode, where the collector retries (paper: 3 for some tasks)."""
    critic_iterations: int = 2_000
    policy_iterations: int = 1_000
    reward: RewardKind | None = None
    """As the critic was trained by default (`of_critic`)."""
    backup: int | None = None
    """Ticks of reward in Q's target (the paper: 1); as the critic was trained by default."""
    evaluate_every: int = 5
    """Epochs; the policy alone, without retry or noise."""
    evaluation_scenes: int = 50
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("epochs", "episodes", "attempts", "evaluate_every", "evaluation_scenes"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} is {getattr(self, name)}, must be at least 1")
        if self.backup is not None and self.backup < 1:
            raise ConfigError(f"backup is {self.backup}, must be at least 1 tick")
        if self.noise < 0:
            raise ConfigError(f"noise is {self.noise}, must be at least 0")

    def of_critic(self, card: Mapping[str, Any]) -> Improvement:
        """With what was left to the critic's card; what that does not tell is as far_app/checkpoints has it."""
        training = card.get("training", {})
        reward, backup = training.get("reward", "shaped"), training.get("backup", 8)
        return replace(self, reward=self.reward or reward, backup=self.backup or backup)

    def scenes(self, epoch: int) -> range:
        """What an epoch (1-based) collects from."""
        first = COLLECT_SCENES + self.seed * SCENES_A_SEED + (epoch - 1) * self.episodes
        return range(first, first + self.episodes)

    def evaluated(self, epoch: int) -> bool:
        return epoch % self.evaluate_every == 0 or epoch == self.epochs


class Noisy:
    """far_app.protocols.Method: another one with exploration noise on every action (paper: N(0, 0.1²))."""

    def __init__(self, method: Method, sigma: float) -> None:
        self.method, self.name = method, method.name
        self.noise = PerturbationConfig(kind="gaussian", probability=1.0, sigma=sigma, first_attempt=1)

    @property
    def policy(self) -> Policy:
        return self.method.policy

    def begin(self, scene_seed: int) -> None:
        self.method.begin(scene_seed)

    def adapt(self, attempt: Attempt, cancelled: Any, progress: Progress) -> Adaptation:
        return self.method.adapt(attempt, cancelled, progress)

    def perturb(self, attempt_index: int, scene_seed: int) -> Perturbation:
        retry = self.method.perturb(attempt_index, scene_seed)
        noise = perturbation(self.noise, scene_seed, attempt_index, purpose="collection noise")
        return lambda tick: retry(tick) + noise(tick)


@dataclass(frozen=True, kw_only=True)
class Epoch:
    """One line of the log; counts are of everything collected so far."""

    epoch: int
    episodes: int = 0
    """Also the environment resets: a retry goes on from the scene that the failure left."""
    timesteps: int = 0
    """Policy ticks."""
    solved: int = 0
    """Of this epoch's episodes, within their attempts."""
    successes: int = 0
    """Attempts in D_succ."""
    failures: int = 0
    """Attempts in D_fail."""
    evaluation: dict[str, int] | None = field(default=None)
    """{"scenes": N, "solved": n} of the policy alone, where it was evaluated."""


def read_log(path: Path) -> list[Epoch]:
    """The epochs that are done; a torn last line (a killed run) is left out."""
    found = []
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            found.append(Epoch(**json.loads(line)))
        except json.JSONDecodeError:
            continue
    return found


def before_and_after(before: Sequence[Mapping[str, Any]], after: Sequence[Mapping[str, Any]]) -> str:
    """What learning did to the policy alone, from the records of two evaluations: on the scenes of both, so that each
    scene is its own control. One line of Markdown."""
    from far_app.statistics import mcnemar, paired_difference

    was, now = ({int(r["scene"]): bool(r["success"]) for r in records} for records in (before, after))
    scenes = sorted(was.keys() & now.keys())
    if not scenes:
        return "before and after share no scene: nothing to compare"
    mean, low, high = paired_difference([now[s] for s in scenes], [was[s] for s in scenes])
    gained, lost = sum(now[s] and not was[s] for s in scenes), sum(was[s] and not now[s] for s in scenes)
    span = f" [{100 * max(-1.0, low):+.1f}, {100 * min(1.0, high):+.1f}]" if high > low and len(scenes) > 1 else ""
    return (
        f"after − before on the same {len(scenes)} scenes: {100 * mean:+.1f} points{span}; {gained} gained, {lost} "
        f"lost, exact McNemar p = {mcnemar(gained, lost):.3g}"
    )


def table(epochs: Sequence[Epoch]) -> str:
    """The evaluations as Markdown."""
    from far_app.statistics import wilson

    lines = ["| epoch | episodes (resets) | timesteps | success of the policy alone |", "|---|---|---|---|"]
    for e in epochs:
        if e.evaluation is not None:
            solved, scenes = e.evaluation["solved"], e.evaluation["scenes"]
            low, high = wilson(solved, scenes)
            rate = f"{100 * solved / scenes:.1f} [{100 * low:.1f}, {100 * high:.1f}]"
            lines.append(f"| {e.epoch} | {e.episodes} | {e.timesteps} | {rate} |")
    return "\n".join(lines)
