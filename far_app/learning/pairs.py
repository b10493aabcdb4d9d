"""Contrastive pairs (paper, Contrastive Sample Construction): for each flagged chunk, better ones from the policy.

    C(s_t)      = { a^(1) … a^(M) },  a^(i) ~ π(·|s_t)
    C_safe(s_t) = { a^(i) | d_min ≤ ‖a^(i) − a⁻‖ ≤ d_max }           d_min: a number, or the mean over C(s_t)
    A_t⁺        = TopK over C_safe of Q(s_t, a),  Q the smaller of the twins

The negative a⁻ is the chunk that was *sent* to the arm. Distances leave the gripper out by default. Called by
far_app/methods after attribution.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from far_app.config import PairsConfig
from far_app.learning.cancellation import Cancelled, check
from far_app.learning.threads import Each, in_turn
from far_app.types import ARM_DIMS, TRANSLATION_DIMS

BATCH = 128
"""Chunks a pass; small enough that a cancellation is noticed within a few tens of milliseconds."""

Sampler = Callable[[Float[Tensor, "B F"], Float[Tensor, "B H A"]], Float[Tensor, "B H A"]]
"""Chunks denoised from noise under the policy that acted."""
Score = Callable[[Float[Tensor, "B F"], Float[Tensor, "B H A"]], Float[Tensor, "B"]]
"""Q(s, a)."""


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """What FCPA learns from: S states with a negative each, P positives, each owned by one of the states."""

    features: Float[Tensor, "S F"]
    """Cached encoder features of the states."""
    negatives: Float[Tensor, "S H A"]
    positives: Float[Tensor, "P H A"]
    owner: Int[Tensor, "P"]
    """Row of the state that each positive belongs to, ascending."""
    weights: Float[Tensor, "P"]
    """1, or the advantage weight when the objective is awr."""
    empty_states: int = 0
    """Flagged states whose filtered set was empty under [d_min, d_max], before the fallback."""
    dropped_states: int = 0
    """Flagged states left without a positive, and so without a pair."""
    kept: tuple[int, ...] = ()
    """Which of the flagged states, by their order, the S rows are; for the record."""

    def __len__(self) -> int:
        return len(self.positives)

    def first(self, most: int) -> Int[Tensor, "P2"]:
        """Rows of every state's first positives, `most` at most."""
        counts = torch.bincount(self.owner, minlength=len(self.features))
        place = torch.arange(len(self), device=self.owner.device) - (counts.cumsum(0) - counts)[self.owner]
        return torch.nonzero(place < most)[:, 0]


def candidates(
    sample: Sampler,
    features: Float[Tensor, "S F"],
    noise: Float[Tensor, "S M H A"],
    cancelled: Cancelled,
    each: Each = in_turn,
) -> Float[Tensor, "S M H A"]:
    """M chunks from the policy for every state, in batches of BATCH across states."""
    states, per_state = noise.shape[:2]
    if not states:
        return torch.zeros_like(noise)
    flat = noise.flatten(0, 1)
    state = torch.arange(states).repeat_interleave(per_state)

    def batch(rows: Int[Tensor, "B"]) -> Float[Tensor, "B H A"]:
        check(cancelled)
        return sample(features[state[rows]], flat[rows])

    return torch.cat(each(batch, torch.arange(len(flat)).split(BATCH))).reshape(noise.shape)


def explored(chunks: Float[Tensor, "S M H A"], sigma: float, rng: np.random.Generator) -> Float[Tensor, "S M H A"]:
    """Every candidate moved by a translation of its own, the same at all its steps: a^(i) + δ, δ ~ N(0, σ²) in x, y, z.
    A state's first candidate stays the policy's own."""
    states, per_state = chunks.shape[:2]
    offsets = sigma * rng.standard_normal((states, per_state, 1, TRANSLATION_DIMS), dtype=np.float32)
    offsets[:, 0] = 0.0
    moved = chunks.clone()
    moved[..., :TRANSLATION_DIMS] += torch.from_numpy(offsets).to(chunks.device)
    return moved.clamp(-1.0, 1.0)


def distance(
    chunks: Float[Tensor, "S M H A"], negatives: Float[Tensor, "S H A"], arm_only: bool
) -> Float[Tensor, "S M"]:
    """d(a^(i), a⁻): L2 over the chunk's entries, in action units; without the gripper's when arm_only."""
    difference = chunks - negatives[:, None]
    if arm_only:
        difference = difference[..., :ARM_DIMS]
    return difference.flatten(2).norm(dim=2)


def moderate(distances: Float[Tensor, "S M"], config: PairsConfig) -> tuple[Bool[Tensor, "S M"], Bool[Tensor, "S"]]:
    """Which candidates deviate moderately, and which states had none and so fell under the empty-set rule."""
    d_min = distances.mean(dim=1, keepdim=True) if config.d_min == "mean" else float(config.d_min)
    far_enough = distances >= d_min
    safe = far_enough & (distances <= config.d_max)
    empty = ~safe.any(dim=1)
    if config.on_empty == "drop_d_max":
        safe = torch.where(empty[:, None], far_enough, safe)
    return safe, empty


def top_k(scores: Float[Tensor, "S M"], allowed: Bool[Tensor, "S M"], k: int) -> Bool[Tensor, "S M"]:
    """The k best-scored allowed candidates of each state; fewer where fewer are allowed."""
    best = scores.masked_fill(~allowed, -torch.inf).topk(min(k, scores.shape[1]), dim=1).indices
    return torch.zeros_like(allowed).scatter_(1, best, True) & allowed


def select(
    chunks: Float[Tensor, "S M H A"],
    features: Float[Tensor, "S F"],
    negatives: Float[Tensor, "S H A"],
    score: Score,
    config: PairsConfig,
    shown: Float[Tensor, "S G"] | None = None,
) -> Pairs:
    """Positives out of the candidates. choose = random is the paper's ablation: K plain samples, neither filtered nor
    ranked. `shown` is what `score` takes for each state, where that is not the policy's features."""
    states, per_state = chunks.shape[:2]
    if config.choose == "random":
        chosen = (torch.arange(per_state, device=chunks.device) < config.positives).expand(states, -1)
        empty = torch.zeros(states, dtype=torch.bool, device=chunks.device)
    else:
        allowed, empty = moderate(distance(chunks, negatives, config.arm_only), config)
        states_shown = (features if shown is None else shown).repeat_interleave(per_state, dim=0)
        scores = score(states_shown, chunks.flatten(0, 1)).reshape(states, per_state)
        chosen = top_k(scores, allowed, config.positives)
    kept = chosen.any(dim=1)
    owner = (kept.cumsum(0) - 1).repeat_interleave(chosen.sum(dim=1))
    return Pairs(
        features=features[kept], negatives=negatives[kept], positives=chunks[chosen], owner=owner,
        weights=torch.ones(len(owner), device=chunks.device), empty_states=int(empty.sum()),
        dropped_states=int((~kept).sum()), kept=tuple(kept.nonzero().flatten().tolist()),
    )  # fmt: skip


def weighted_trajectory(
    features: Float[Tensor, "S F"], chunks: Float[Tensor, "S H A"], advantages: Float[Tensor, "S"]
) -> Pairs:
    """What the awr objective imitates instead of pairs: the failed attempt's own chunks, weighted by exp(A/η)
    (η = 1/3, weights clipped at 100; paper, Eq. awr, and its choices)."""
    weights = torch.exp(advantages * AWR_INVERSE_TEMPERATURE).clamp(max=AWR_WEIGHT_LIMIT)
    return Pairs(
        features=features,
        negatives=chunks,
        positives=chunks,
        owner=torch.arange(len(chunks), device=chunks.device),
        weights=weights,
    )


AWR_INVERSE_TEMPERATURE = 3.0
"""1/η."""
AWR_WEIGHT_LIMIT = 100.0


def merged(rounds: Sequence[Pairs]) -> Pairs:
    """All pairs of a trial's rounds as one set."""
    starts = [sum(len(r.features) for r in rounds[:i]) for i in range(len(rounds))]
    return Pairs(
        features=torch.cat([r.features for r in rounds]),
        negatives=torch.cat([r.negatives for r in rounds]),
        positives=torch.cat([r.positives for r in rounds]),
        owner=torch.cat([r.owner + start for r, start in zip(rounds, starts, strict=True)]),
        weights=torch.cat([r.weights for r in rounds]),
        empty_states=sum(r.empty_states for r in rounds),
        dropped_states=sum(r.dropped_states for r in rounds),
    )
