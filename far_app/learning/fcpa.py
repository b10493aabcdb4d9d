"""Failure-Contrastive Preference Adaptation: a few gradient steps that prefer the positives to the sent chunks.

    θ ← AdamW(θ, ∇ mean over pairs of L_pref),  10 steps          (paper, Failure-Contrastive Preference Adaptation)

All pairs are in every step, under fresh draws. Only the denoiser's weights move; the encoder is frozen and its features
cached. The printed loss can raise l⁺ together with l⁻; FCPAConfig.guard offers remedies. Called by far_app/methods with
a private copy of the denoiser.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from torch import nn

from far_app.config import FCPAConfig
from far_app.errors import ConfigError, PolicyError
from far_app.learning.adamw import FlatAdamW, guarded_step
from far_app.learning.cancellation import Cancelled, check
from far_app.learning.pairs import Pairs
from far_app.learning.preference import Cloning, Demonstrations, Noising, Objective, draw
from far_app.learning.threads import Each, in_turn
from far_app.learning.trainable import Arrange, trainable
from far_app.types import AdaptationStep

FIXED_DRAWS = 1
"""Draws a state for the reported l⁺ and l⁻; the same before the first and after every step."""
REPORTED = 2
"""Positives a state in what is reported, where it is for people alone: no guard decides by it."""


@dataclass(frozen=True, kw_only=True)
class Update:
    """How an update went. The denoiser then holds the adapted weights, or its old ones when `changed` is False."""

    status: str
    """"adapted", "stopped" (a guard ended it) or "failed" (a loss or gradient was not finite)."""
    changed: bool
    history: tuple[AdaptationStep, ...]
    note: str = ""


def check_config(config: FCPAConfig, demonstrations: Demonstrations | None) -> None:
    """Refuse combinations that mean nothing, before any attempt is made."""
    if config.guard == "scale" and config.objective != "pairwise":
        raise ConfigError(
            f"fcpa.guard is scale but fcpa.objective is {config.objective}, which has no loser to scale; "
            "use guard none, stop or bc"
        )
    if config.guard == "bc" and demonstrations is None:
        raise ConfigError("fcpa.guard is bc but no demonstrations were given; give some or use guard none, stop, scale")


def adapt(
    denoiser: nn.Module,
    noising: Noising,
    pairs: Pairs,
    config: FCPAConfig,
    rng: np.random.Generator,
    cancelled: Cancelled,
    progress: Callable[[AdaptationStep], None],
    demonstrations: Demonstrations | None = None,
    arrange: Arrange = trainable,
    each: Each = in_turn,
) -> Update:
    """FCPA on these pairs, in place; `denoiser` is the caller's private copy of the weights that acted, in eval mode.
    `arrange` says how it is run, the quickest way or plainly; `each`, on how many threads.
    Progress is told before the first step (step 0) and after each. Raises AdaptationCancelledError on cancellation;
    the copy is then of no use."""
    check_config(config, demonstrations)
    runner = arrange(denoiser, pairs.negatives.shape[1], cancelled=cancelled)
    check(cancelled)
    objective = Objective(runner, noising, pairs, config, cancelled, each)
    states = len(pairs.features)
    fixed = draw(rng, states, FIXED_DRAWS, noising.steps, pairs.negatives)
    optimiser = FlatAdamW(runner.parameters, lr=config.lr)
    start = optimiser.weights.clone()
    cloning = None
    if config.guard == "bc" and demonstrations is not None:
        cloning = Cloning(demonstrations=demonstrations, weight=config.bc_weight, rng=rng)
    decides = config.guard in {"stop", "scale"}
    history: list[AdaptationStep] = []

    def report(step: int) -> AdaptationStep:
        loss, winner, loser = objective.report(fixed, most=None if decides else REPORTED)
        if not (math.isfinite(loss) and math.isfinite(winner)):
            raise PolicyError(f"loss {loss} and l⁺ {winner} at step {step} of {config.steps}; lower fcpa.lr")
        history.append(AdaptationStep(
            step=step, steps=config.steps, loss=loss, winner_error=winner, loser_error=loser
        ))  # fmt: skip
        progress(history[-1])
        return history[-1]

    try:
        limit = report(0).winner_error * (1 + config.guard_rise)
        for step in range(1, config.steps + 1):
            before = optimiser.weights.clone() if decides else start
            fresh = draw(rng, states, config.draws, noising.steps, pairs.negatives)
            if config.guard == "scale":
                guarded_step(optimiser, *objective.gradients(fresh))
            else:
                optimiser.step(objective.gradient(fresh, cloning))
            check(cancelled)
            runner.refresh()
            winner = report(step).winner_error
            if decides and winner > limit:
                optimiser.weights.copy_(before)
                note = f"step {step} raised l⁺ to {winner:.3g}, above {limit:.3g}; it was undone"
                return Update(status="stopped", changed=step > 1, history=tuple(history), note=note)
    except PolicyError as error:
        optimiser.weights.copy_(start)
        return Update(status="failed", changed=False, history=tuple(history), note=str(error))
    return Update(status="adapted", changed=config.steps > 0, history=tuple(history))
