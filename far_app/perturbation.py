"""δ_t: small perturbations that let a retry try something else (paper, Perturbation for Retry Exploration).

    gaussian:   δ_t ~ N(0, σ²) with probability ε, else 0                       (independent by tick)
    smoothed:   δ*  ~ N(0, σ²) with probability ε, else 0, held for h ticks
                δ_t = α δ_{t−1} + (1 − α) δ*,   δ_{−1} = 0

Zero on a first attempt (unless asked for); the gripper is never perturbed. Every number is keyed by (scene, attempt,
tick), so δ_t does not depend on which ticks were asked for. The paper leaves open how long a drawn zero lasts; here it
lasts h ticks like a drawn target, so that ε is the share of perturbed time for both kinds.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from far_app.config import PerturbationConfig
from far_app.seeding import generator
from far_app.types import ACTION_DIM

Perturbation = Callable[[int], Float[np.ndarray, "A"]]
"""δ by tick, in action units."""


def probability(config: PerturbationConfig, attempt_index: int) -> float:
    """ε_explore of an attempt (1-based); adaptive: 0.3 + 0.1 k at retry k, the first retry being k = 0 (paper)."""
    if not config.adaptive:
        return config.probability
    return min(1.0, 0.3 + 0.1 * max(0, attempt_index - 2))


def perturbation(
    config: PerturbationConfig, scene_seed: int, attempt_index: int, purpose: str = "perturbation"
) -> Perturbation:
    """δ by tick for one attempt: zeros before config.first_attempt, or when kind is none."""
    if config.kind == "none" or attempt_index < config.first_attempt or config.sigma == 0:
        return lambda tick: np.zeros(ACTION_DIM)
    epsilon = probability(config, attempt_index)

    def drawn(index: int) -> Float[np.ndarray, "A"]:
        """N(0, σ²) on the perturbed dimensions with probability ε, else zeros."""
        rng = generator(purpose, scene_seed, attempt_index, index)
        delta = np.zeros(ACTION_DIM)
        if rng.random() < epsilon:
            delta[list(config.dims)] = config.sigma * rng.standard_normal(len(config.dims))
        return delta

    if config.kind == "gaussian":
        return drawn

    smoothed: list[Float[np.ndarray, "A"]] = []
    """δ_0 … of the ticks reached so far."""

    def smooth(tick: int) -> Float[np.ndarray, "A"]:
        while len(smoothed) <= tick:
            t = len(smoothed)
            before = smoothed[-1] if smoothed else np.zeros(ACTION_DIM)
            smoothed.append(config.alpha * before + (1 - config.alpha) * drawn(t // config.hold * config.hold))
        return smoothed[tick].copy()

    return smooth
