"""Training and calibrating the success head (far_app/learning/success.py).

Labels need no sensor of success, only each attempt's outcome: the last frames of a success are positive; the frames of
a failure, and those of a success well before its end, are negative; what lies between is neither.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from far_app.errors import ConfigError
from far_app.learning.critic_source import encoded
from far_app.learning.dataset import Episode
from far_app.learning.policy import DiffusionPolicy
from far_app.learning.success import SuccessHead, SuccessRule, best, conformal_lower, conformal_threshold

log = logging.getLogger(__name__)

EVEN_ODDS = 0.0
"""Logit."""


@dataclass(frozen=True, kw_only=True)
class SuccessTraining:
    iterations: int = 2_000
    batch: int = 256
    """Half of them positive."""
    lr: float = 1e-3
    weight_decay: float = 1e-3
    last: int = 10
    """Last frames of a success that are positive."""
    gap: int = 10
    """Frames before those that are neither."""
    held_out: float = 0.5
    """Share of the attempts that only calibrate."""
    consecutive: int = 5
    """k frames that must agree."""
    false_success: float = 0.01
    """α: probability that a failed attempt is taken for a success, at most."""
    missed: float = 0.05
    """Probability that a success scores too low even to be asked about, at most."""
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("held_out", "false_success", "missed"):
            if not 0 < getattr(self, name) < 1:
                raise ConfigError(f"{name} is {getattr(self, name)}, must be between 0 and 1")
        for name in ("consecutive", "last"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} is {getattr(self, name)}, must be at least 1")


@dataclass(frozen=True, kw_only=True)
class Watched:
    """An attempt through the frozen encoder."""

    features: Float[np.ndarray, "N F"]
    success: bool
    seed: int

    def early(self, training: SuccessTraining) -> int:
        """How many frames from the start are no success."""
        return max(0, len(self.features) - training.last - training.gap) if self.success else len(self.features)


def watch(policy: DiffusionPolicy, episodes: Sequence[Episode]) -> list[Watched]:
    """Features of every frame, once."""
    return [Watched(features=encoded(policy, e).features, success=e.success, seed=e.seed) for e in episodes]


def scores_of(head: SuccessHead, features: Float[np.ndarray, "N F"]) -> Float[np.ndarray, "N"]:
    with torch.no_grad():
        return head(torch.from_numpy(features)).numpy()


def train_success(
    demonstrations: Sequence[Watched], attempts: Sequence[Watched], training: SuccessTraining
) -> tuple[SuccessHead, SuccessRule, dict[str, object]]:
    """A head, its calibrated rule, and what the card should say. Raises ConfigError where there is too little."""
    rng = np.random.default_rng(training.seed)
    order = rng.permutation(len(attempts))
    held_out = [attempts[i] for i in order[: round(training.held_out * len(attempts))]]
    learnt = [*demonstrations, *(attempts[i] for i in order[len(held_out) :])]
    head = fit(learnt, training, rng)
    rule, card = calibrated(head, held_out, training)
    return head, rule, card | {"scenes": sorted({w.seed for w in (*learnt, *held_out)}), "learnt_from": len(learnt)}


def fit(learnt: Sequence[Watched], training: SuccessTraining, rng: np.random.Generator) -> SuccessHead:
    """Logistic regression through one hidden layer, positives and negatives equally often."""
    positive = [w.features[-training.last :] for w in learnt if w.success]
    negative = [w.features[: w.early(training)] for w in learnt]
    if not positive or all(w.success for w in learnt):
        raise ConfigError("a success detector learns from successes and failures; give demonstrations and --attempts")
    good, bad = torch.from_numpy(np.concatenate(positive)), torch.from_numpy(np.concatenate(negative))
    torch.manual_seed(training.seed)
    head = SuccessHead(good.shape[1])
    everything = torch.cat([good, bad])
    head.mean.copy_(everything.mean(0))
    std = everything.std(0)
    head.std.copy_(torch.where(std > 1e-4, std, torch.ones_like(std)))
    optimizer = torch.optim.AdamW(head.parameters(), lr=training.lr, weight_decay=training.weight_decay)
    half = training.batch // 2
    labels = torch.cat([torch.ones(half), torch.zeros(half)])
    for iteration in range(training.iterations):
        batch = torch.cat([good[rng.integers(0, len(good), half)], bad[rng.integers(0, len(bad), half)]])
        loss = nn.functional.binary_cross_entropy_with_logits(head(batch), labels)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        if (iteration + 1) % 500 == 0:
            log.info("iteration %d: loss %.4f", iteration + 1, loss.item())
    return head.eval().requires_grad_(False)


def calibrated(
    head: SuccessHead, held_out: Sequence[Watched], training: SuccessTraining
) -> tuple[SuccessRule, dict[str, object]]:
    """Thresholds from attempts that the head has not learnt from. The early part of a success must not be taken for one
    either, nor anything that the head itself holds for less likely than not: the threshold is the highest of these."""
    k = training.consecutive
    scores = [(w, scores_of(head, w.features)) for w in held_out]
    failures = np.array([best(s, k) for w, s in scores if not w.success])
    successes = np.array([best(s, k) for w, s in scores if w.success])
    early = np.array([best(s[: w.early(training)], k) for w, s in scores if w.success])
    threshold = max(EVEN_ODDS, conformal_threshold(failures, training.false_success))
    if (len(early) + 1) * training.false_success >= 1:
        threshold = max(threshold, conformal_threshold(early, training.false_success))
    rule = SuccessRule(
        consecutive=k, threshold=threshold, lower=conformal_lower(successes, training.missed),
        false_success=training.false_success,
    )  # fmt: skip
    found = float(np.mean(successes > threshold)) if len(successes) else math.nan
    log.info("threshold %.2f from %d failures; %.3f of %d held-out successes lie above it", threshold, len(failures),
             found, len(successes))  # fmt: skip
    return rule, {"calibrated_on_failures": len(failures), "held_out_successes": len(successes), "found": found}
