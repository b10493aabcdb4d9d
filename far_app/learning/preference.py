"""The preference loss of a set of pairs: its value on given draws, and its gradient on the denoiser's weights.

    l_diff(a, s; θ) = E_{k,ε} ‖ε − ε_θ(a_k, s, k)‖²
    L_pref          = − log σ( β [ l_diff(a⁻, s; θ) − l_diff(a⁺, s; θ) ] )          (paper, Eq. preference)

averaged over all pairs. The expectation is a mean over a few draws (k, ε), k stratified over the diffusion steps, the
same draws for a state's negative and all its positives. Called by fcpa.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from far_app.config import FCPAConfig
from far_app.learning.cancellation import Cancelled, check
from far_app.learning.pairs import Pairs
from far_app.learning.trainable import Trainable
from far_app.types import ARM_DIMS

AddNoise = Callable[[Float[Tensor, "B H A"], Float[Tensor, "B H A"], Int[Tensor, "B"]], Float[Tensor, "B H A"]]
"""a_k from (a, ε, k)."""
BATCH = 256
"""Rows a pass: enough to be quick, few enough that a cancellation between two is noticed within 100 ms."""
STATES_AT_ONCE = 16
"""States whose activations are kept for one backward pass; bounds memory, not the result."""
BC_BATCH = 64
"""Demonstration chunks a step when guard is bc."""


@dataclass(frozen=True, kw_only=True)
class Noising:
    """The forward process the denoiser was trained under."""

    add_noise: AddNoise
    steps: int
    """Diffusion steps k is drawn from."""


@dataclass(frozen=True, kw_only=True)
class Demonstrations:
    """Expert chunks with their cached features, for the bc guard."""

    features: Float[Tensor, "N F"]
    chunks: Float[Tensor, "N H A"]


@dataclass(frozen=True, kw_only=True)
class Cloning:
    """The bc guard's term of the loss: its weight, what is cloned, and what picks the minibatches."""

    demonstrations: Demonstrations
    weight: float
    rng: np.random.Generator


@dataclass(frozen=True, kw_only=True)
class Draws:
    """D draws of (k, ε) for each of S states."""

    k: Int[Tensor, "S D"]
    noise: Float[Tensor, "S D H A"]


def draw(
    rng: np.random.Generator, states: int, draws: int, diffusion_steps: int, like: Float[Tensor, "N H A"]
) -> Draws:
    """Fresh draws for chunks like these; k stratified: a state's D draws fall one into each of D equal ranges, within
    which the states are spread evenly too."""
    spread = np.stack([rng.permutation(states) for _ in range(draws)], axis=1) + rng.random((states, draws))
    k = ((np.arange(draws) + spread / states) / draws * diffusion_steps).astype(np.int64)
    noise = rng.standard_normal((states, draws, *like.shape[1:]), dtype=np.float32)
    k = k.clip(max=diffusion_steps - 1)
    return Draws(k=torch.from_numpy(k).to(like.device), noise=torch.from_numpy(noise).to(like.device))


def denoising_errors(
    denoiser: Trainable,
    noising: Noising,
    chunks: Float[Tensor, "N H A"],
    features: Float[Tensor, "S F"],
    draws: Draws,
    owner: Int[Tensor, "N"],
    config: FCPAConfig,
    cancelled: Cancelled,
) -> list[Float[Tensor, "B"]]:
    """Squared error, summed (or averaged) over entries (the arm's alone with `arm_only`), of every draw of every
    chunk in its owner's state: N · D rows, a chunk's draws side by side, in batches. `per_chunk` makes l_diff of
    them."""
    per_state = draws.k.shape[1]
    state = owner.repeat_interleave(per_state)
    k, noise = draws.k[owner].flatten(), draws.noise[owner].flatten(0, 1)
    noisy = noising.add_noise(chunks.repeat_interleave(per_state, dim=0), noise, k)
    errors = []
    dims = ARM_DIMS if config.arm_only else chunks.shape[2]
    for rows in torch.arange(len(noisy)).split(BATCH):
        check(cancelled)
        here, row = state[rows].unique(return_inverse=True)
        predicted = denoiser.run(noisy[rows], k[rows], denoiser.condition(features[here]).index_select(0, row))
        if predicted.requires_grad:
            predicted.register_hook(lambda _: check(cancelled))  # on the way back too, batch by batch
        squared = (noise[rows] - predicted)[..., :dims].square().flatten(1)
        errors.append(squared.sum(1) if config.reduction == "sum" else squared.mean(1))
    return errors


def per_chunk(errors: list[Float[Tensor, "B"]], draws: int) -> Float[Tensor, "N"]:
    """l_diff of each chunk: the mean over its draws, without gradients."""
    return torch.cat([e.detach() for e in errors]).reshape(-1, draws).mean(1)


def preference_loss(
    winner: Float[Tensor, "P"], loser: Float[Tensor, "P"], config: FCPAConfig, weights: Float[Tensor, "P"]
) -> Float[Tensor, ""]:
    """Sum over pairs of the objective: L_pref, or one of the paper's ablations of it."""
    if config.objective == "pairwise":
        return -functional.logsigmoid(config.beta * (loser - winner)).sum()
    if config.objective == "no_positive":
        return -functional.logsigmoid(config.beta * loser).sum()
    return (weights * winner).sum()  # no_negative (weights are 1) and awr


def blocks(pairs: Pairs) -> Iterator[tuple[slice, slice]]:
    """Pairs in groups of STATES_AT_ONCE states: a slice of the states and one of their positives."""
    states = len(pairs.features)
    ends = torch.bincount(pairs.owner, minlength=states).cumsum(0).tolist()
    for first in range(0, states, STATES_AT_ONCE):
        last = min(first + STATES_AT_ONCE, states)
        yield slice(first, last), slice(ends[first - 1] if first else 0, ends[last - 1])


class Objective:
    """The preference loss of one set of pairs: its value on fixed draws, its gradients on fresh ones."""

    def __init__(
        self, denoiser: Trainable, noising: Noising, pairs: Pairs, config: FCPAConfig, cancelled: Cancelled
    ) -> None:
        self.denoiser, self.noising, self.pairs, self.config = denoiser, noising, pairs, config
        self.cancelled = cancelled

    def errors(self, chunks: Tensor, owner: Tensor, states: slice, draws: Draws) -> list[Tensor]:
        here = Draws(k=draws.k[states], noise=draws.noise[states])
        return denoising_errors(
            self.denoiser, self.noising, chunks, self.pairs.features[states], here, owner, self.config,
            self.cancelled,
        )  # fmt: skip

    @torch.no_grad()
    def report(self, draws: Draws) -> tuple[float, float, float]:
        """(loss, l⁺, l⁻), each a mean over pairs, on these draws."""
        pairs, count = self.pairs, draws.k.shape[1]
        chunks, owner = pairs.positives, pairs.owner
        if self.config.objective != "awr":
            chunks = torch.cat([chunks, pairs.negatives])
            owner = torch.cat([owner, torch.arange(len(pairs.negatives), device=owner.device)])
        errors = per_chunk(self.errors(chunks, owner, slice(0, len(pairs.features)), draws), count)
        winner, loser = errors[: len(pairs)], torch.full_like(errors[: len(pairs)], math.nan)
        if self.config.objective != "awr":
            loser = errors[len(pairs) :][pairs.owner]
        loss = preference_loss(winner, loser, self.config, pairs.weights) / len(pairs)
        return float(loss), float(winner.mean()), float(loser.mean())

    def gradient(self, draws: Draws, cloning: Cloning | None = None) -> Float[Tensor, "P"]:
        """The loss's gradient, flat; with that of cloning added."""
        total = self.zeros()
        self.gather(draws, total, total)
        if cloning is not None:
            self.gather_cloning(cloning, total)
        return self.denoiser.pull_back(total)

    def gradients(self, draws: Draws) -> tuple[Float[Tensor, "P"], Float[Tensor, "P"]]:
        """(g⁺, g⁻): the loss's gradient through the positives' errors and through the negatives', flat; their sum is
        the gradient of the loss. Following −g⁺ lowers l⁺, following −g⁻ raises l⁻."""
        at_winner, at_loser = self.zeros(), self.zeros()
        self.gather(draws, at_winner, at_loser)
        return self.denoiser.pull_back(at_winner), self.denoiser.pull_back(at_loser)

    def zeros(self) -> list[Tensor]:
        return [torch.zeros_like(leaf) for leaf in self.denoiser.leaves]

    def gather(self, draws: Draws, at_winner: list[Tensor], at_loser: list[Tensor]) -> None:
        """Add the loss's gradient on the denoiser's leaves: through l⁺ to one sum, through l⁻ to the other."""
        count, objective = draws.k.shape[1], self.config.objective
        for states, rows in blocks(self.pairs):
            owner = self.pairs.owner[rows] - states.start
            own = torch.arange(states.stop - states.start, device=owner.device)
            winners, losers = [], []
            winner = loser = torch.zeros(len(owner), device=owner.device)
            if objective != "no_positive":
                winners = self.errors(self.pairs.positives[rows], owner, states, draws)
                winner = per_chunk(winners, count)
            if objective in {"pairwise", "no_positive"}:
                losers = self.errors(self.pairs.negatives[states], own, states, draws)
                loser = per_chunk(losers, count)[owner]
            at = winner.requires_grad_(), loser.clone().requires_grad_()
            loss = preference_loss(*at, self.config, self.pairs.weights[rows]) / len(self.pairs)
            to_winner, to_loser = torch.autograd.grad(loss, at, materialize_grads=True)
            self.accumulate(at_winner, winners, to_winner, count)
            self.accumulate(
                at_loser, losers, torch.zeros_like(own, dtype=torch.float32).index_add_(0, owner, to_loser), count
            )

    def accumulate(self, totals: list[Tensor], errors: list[Tensor], share: Float[Tensor, "N"], draws: int) -> None:
        """Add the gradients of Σ share · l_diff."""
        if not errors:
            return
        check(self.cancelled)
        weights = (share / draws).repeat_interleave(draws).split([len(e) for e in errors])
        weighted = torch.stack([error @ weight for error, weight in zip(errors, weights, strict=True)]).sum()
        gradients = torch.autograd.grad(weighted, self.denoiser.leaves, materialize_grads=True)
        for total, gradient in zip(totals, gradients, strict=True):
            total.add_(gradient)

    def gather_cloning(self, cloning: Cloning, total: list[Tensor]) -> None:
        """Add the gradient of the weighted behaviour-cloning loss on a minibatch of demonstration chunks."""
        demonstrations, rng = cloning.demonstrations, cloning.rng
        rows = torch.from_numpy(rng.integers(len(demonstrations.chunks), size=BC_BATCH))
        chunks = demonstrations.chunks[rows]
        draws = draw(rng, BC_BATCH, 1, self.noising.steps, chunks)
        errors = denoising_errors(
            self.denoiser, self.noising, chunks, demonstrations.features[rows], draws, torch.arange(BC_BATCH),
            self.config, self.cancelled,
        )  # fmt: skip
        self.accumulate(total, errors, chunks.new_full((BC_BATCH,), cloning.weight / BC_BATCH), 1)
