"""`far bench critic`: can Q rank what the policy would do? Ask it before trusting FAR with a model of your own.

In failed attempts on scenes kept for choices, while the open hand is still away from the object, the policy draws its
chunks anew. How far they spread says whether anything better is among them; how Q ranks them, against how much nearer
to the object each would bring the hand, says whether the critic would find it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jaxtyping import Float
from scipy.stats import spearmanr
from tqdm import tqdm

from far_app.bench.report import write
from far_app.config import RetryConfig
from far_app.errors import ConfigError, FarError
from far_app.evaluation import DEV_SCENES
from far_app.types import ACTION_DIM, Attempt
from hw.rig import load_rig

NEAR = 0.03
"""Metres from the object within which nearer is no longer better."""
BEST = 4
"""How many of the highest Q the gain is taken over."""


@dataclass(frozen=True, kw_only=True)
class CriticOptions:
    """Spread of the policy's samples, and how well Q ranks them by their progress towards the object."""

    task: str = "lift"
    policy: Path | None = None
    """Policy checkpoint; the shipped quickstart model by default."""
    critic: Path | None = None
    """Critic checkpoint; the one beside the policy by default."""
    rig: str = "twin"
    failures: int = 10
    """Failed attempts to look at."""
    first_scene: int = DEV_SCENES
    samples: int = 32
    """Chunks drawn in a state."""
    explore: float = 0.0
    """Move each chunk by a translation drawn with this σ, as pairs.explore does."""
    every: int = 10
    """Ticks between two states of an attempt."""
    json: Path | None = None
    """Write the report here."""

    def __post_init__(self) -> None:
        if self.failures < 1 or self.samples <= BEST or self.every < 1:
            raise ConfigError(
                f"--failures {self.failures}, --samples {self.samples}, --every {self.every}: at least 1, {BEST + 1}, 1"
            )


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(CriticOptions, args=list(arguments), prog="far bench critic")
    write(measure(options), options.json)
    return 0


def measure(options: CriticOptions) -> dict[str, Any]:
    import torch

    from far_app.attempt import Setting
    from far_app.cli.assemble import assemble, shipped, trained
    from far_app.cli.lockstep_twin import lockstep_twin
    from far_app.detectors import TwinCheck
    from far_app.learning.memory import FeatureMemory
    from far_app.learning.pairs import explored
    from far_app.methods.evidence import history
    from far_app.seeding import generator
    from far_app.session.lockstep import adapt_at_once, run_lockstep
    from far_app.session.planners import LockstepPlanner
    from far_app.tasks import task as find_task
    from far_app.trial import trial

    torch.set_num_threads(1)
    task = dataclasses.replace(find_task(options.task, load_rig(options.rig).arm), max_attempts=1)
    policy = options.policy or shipped(task.name, "policy")
    critic = options.critic or (
        policy.with_name("critic.safetensors") if options.policy else shipped(task.name, "critic")
    )
    network, judge = trained(policy, critic, task.name, "cpu", needs_critic=True)
    assert judge is not None
    method = assemble("nr", task, str(policy), critic, "cpu", RetryConfig()).method
    robot = lockstep_twin(options.rig, task, bool(network.config.cameras))
    states: list[Ranking] = []
    failures, scene = 0, options.first_scene
    with tqdm(total=options.failures, unit="failure", leave=False) as bar:
        while failures < options.failures:
            setting = Setting(
                robot=robot, planner=LockstepPlanner(), detector=TwinCheck(task.success_ticks), task=task,
                scale=robot.scale,
            )  # fmt: skip
            result = run_lockstep(trial(scene, method, setting, adapt_at_once), robot.advance)
            scene += 1
            attempt = result.attempts[0]
            if attempt.outcome.success:
                continue
            failures += 1
            bar.update()
            for tick in reaching(attempt, options.every):
                seen = [history(attempt, tick, network.config.n_obs)]
                rng = generator("bench critic", attempt.scene_seed, tick)
                noise = rng.standard_normal((options.samples, network.config.horizon, ACTION_DIM), dtype=np.float32)
                with torch.no_grad():
                    features = network.encode(seen)
                    chunks = network.sample(features.expand(options.samples, -1), torch.from_numpy(noise))
                    chunks = explored(chunks[None], options.explore, rng)[0]
                    scores = judge.q(judge.see(seen, features, FeatureMemory()).expand(options.samples, -1), chunks)
                ahead = robot.scale.translation * chunks[:, :, :3].clamp(-1, 1).sum(1).numpy()
                states.append(Ranking.of(offset(attempt, tick), ahead, scores.numpy()))
    if not states:
        raise FarError(f"in {failures} failed attempts the open hand was never away from the object: nothing to rank")
    spread = [1e3 * s.spread for s in states]
    return {
        "failures": failures,
        "scenes": scene - options.first_scene,
        "states": len(states),
        "spread_mm": {f"p{p}": round(float(np.percentile(spread, p)), 1) for p in (10, 50, 90)},
        "rank_correlation": round(float(np.mean([s.correlation for s in states])), 3),
        f"gain_of_best_{BEST}_mm": round(1e3 * float(np.mean([s.gain for s in states])), 2),
    }


@dataclass(frozen=True, kw_only=True)
class Ranking:
    """Of one state's samples."""

    spread: float
    """Root mean square distance of the chunks' ends from their mean, metres."""
    correlation: float
    """Spearman's, between Q and progress."""
    gain: float
    """Mean progress of the BEST by Q, less that of all, metres."""

    @classmethod
    def of(
        cls, offset: Float[np.ndarray, "3"], ahead: Float[np.ndarray, "N 3"], scores: Float[np.ndarray, "N"]
    ) -> Ranking:
        """`offset`: from the hand to the object; `ahead`: where each chunk would move the hand, both metres."""
        progress = np.linalg.norm(offset) - np.linalg.norm(offset - ahead, axis=1)
        best = np.argsort(-scores)[:BEST]
        return cls(
            spread=float(np.sqrt(((ahead - ahead.mean(0)) ** 2).sum(1).mean())),
            correlation=float(np.asarray(spearmanr(progress, scores))[0]),
            gain=float(progress[best].mean() - progress.mean()),
        )


def reaching(attempt: Attempt, every: int) -> list[int]:
    """Ticks at which the open hand is still away from the object."""
    return [
        t for t in range(0, len(attempt.steps), every)
        if attempt.steps[t].observation.gripper > 0.5 and np.linalg.norm(offset(attempt, t)) > NEAR
    ]  # fmt: skip


def offset(attempt: Attempt, tick: int) -> Float[np.ndarray, "3"]:
    """From the hand to the nearest object, metres, base frame."""
    seen = attempt.steps[tick].observation
    return min((o.position - seen.eef.position for o in seen.objects.values()), key=lambda d: float(np.linalg.norm(d)))
