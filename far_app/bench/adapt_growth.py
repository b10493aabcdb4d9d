"""How an adaptation's cost grows with the attempt's length and with M, without a loop beside it, on one thread. Random
weights."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np

from far_app.config import PairsConfig, RetryConfig
from far_app.types import ACTION_DIM, Attempt, Judge, Outcome, Step

if TYPE_CHECKING:
    from far_app.learning.policy import DiffusionPolicy

TICKS = (75, 150, 300)
CANDIDATES = (16, 32, 64, 128)
TICKS_OF_OTHERS = 150
"""Length of the attempt where M grows; M is the paper's where the length does."""


def growth(preset: str, repeats: int = 3) -> list[dict[str, Any]]:
    """A row for each length and each M: median seconds, whole and by stage."""
    from far_app.cli.assemble import untrained

    network, critic = untrained(preset, "lift", "cpu")
    usual = PairsConfig().candidates
    points = [("ticks", t, t, usual) for t in TICKS] + [("candidates", m, TICKS_OF_OTHERS, m) for m in CANDIDATES]
    rows = []
    for grows, to, ticks, candidates in points:
        attempt = failed_attempt(network, ticks)
        retry = RetryConfig(pairs=PairsConfig(candidates=candidates, d_max=100.0))
        taken = [adapted_in(network, critic, retry, attempt) for _ in range(repeats)]
        stages = {k: round(float(np.median([s[k] for _, s in taken])), 3) for k in taken[0][1]}
        seconds = round(float(np.median([whole for whole, _ in taken])), 3)
        rows.append({"preset": preset, "grows": grows, "to": to, "seconds": seconds, "stages": stages})
    return rows


def adapted_in(network: Any, critic: Any, retry: RetryConfig, attempt: Attempt) -> tuple[float, dict[str, float]]:
    """One adaptation that has seen nothing of the attempt yet."""
    from far_app.learning.runtime import ActingPolicy
    from far_app.methods import Ingredients, method

    def act(network: DiffusionPolicy, version: str, steering: Any = None) -> ActingPolicy:
        return ActingPolicy(network, version, critic, "arranged", steering)

    learner = method("far", Ingredients(network=network, critic=critic, act=act, config=retry))
    began = time.monotonic()
    adaptation = learner.adapt(attempt, lambda: False, lambda step: None)
    return time.monotonic() - began, dict(adaptation.seconds)


def failed_attempt(network: DiffusionPolicy, ticks: int) -> Attempt:
    """Noise in place of pictures and actions, V falling and rising."""
    from far_app.learning.engines.taking import noisy_observation

    rng, config = np.random.default_rng(0), network.config
    seen = [noisy_observation(rng, config.cameras, config.image_size, config.objects) for _ in range(ticks + 1)]
    steps = []
    for t, observation in enumerate(seen[:-1]):
        action = np.clip(rng.normal(scale=0.4, size=ACTION_DIM), -1, 1)
        steps.append(Step(
            tick=t, seq=t, stamp=t / 30, deadline=t / 30, observation=observation, action=action,
            perturbation=np.zeros(ACTION_DIM), commanded=action, sent=action, chunk_tick=t, starved=False,
            policy_version="base", value=float(rng.normal()), reward=0.0, success=False,
        ))  # fmt: skip
    outcome = Outcome(success=False, judged_by=Judge.HORIZON)
    return Attempt(
        index=1, scene_seed=0, steps=tuple(steps), final=seen[-1], outcome=outcome, policy_version="base"
    )  # fmt: skip
