"""The preference loss of a set of pairs: its value on given draws, and its gradient on the denoiser's weights.

    l_diff(a, s; θ) = E_{k,ε} ‖ε − ε_θ(a_k, s, k)‖²
    L_pref          = − log σ( β [ l_diff(a⁻, s; θ) − l_diff(a⁺, s; θ) ] )          (paper, Eq. preference)

averaged over all pairs. The expectation is a mean over a few draws (k, ε), k stratified over the diffusion steps, the
same draws for a state's negative and all its positives. Called by fcpa.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from far_app.config import FCPAConfig
from far_app.learning.cancellation import Cancelled, check
from far_app.learning.pairs import Pairs
from far_app.learning.threads import Each, in_turn
from far_app.learning.trainable import Trainable
from far_app.types import ARM_DIMS

AddNoise = Callable[[Float[Tensor, "B H A"], Float[Tensor, "B H A"], Int[Tensor, "B"]], Float[Tensor, "B H A"]]
"""a_k from (a, ε, k)."""
BATCH = 256
"""Most rows a pass: enough to be quick, few enough that a cancellation is noticed within 100 ms."""
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


@dataclass(frozen=True, kw_only=True)
class Noisy:
    """Noisy chunks, what was added to them, and the states they are denoised in."""

    chunks: Float[Tensor, "R H A"]
    k: Int[Tensor, "R"]
    noise: Float[Tensor, "R H A"]
    features: Float[Tensor, "S F"]
    state: Int[Tensor, "R"]
    """Row of `features` that each is denoised in."""

    def __len__(self) -> int:
        return len(self.chunks)


def noised(
    noising: Noising,
    chunks: Float[Tensor, "N H A"],
    features: Float[Tensor, "S F"],
    draws: Draws,
    owner: Int[Tensor, "N"],
) -> Noisy:
    """Every draw of every chunk in its owner's state: N · D rows, a chunk's draws side by side."""
    per_state = draws.k.shape[1]
    k, noise = draws.k[owner].flatten(), draws.noise[owner].flatten(0, 1)
    return Noisy(
        chunks=noising.add_noise(chunks.repeat_interleave(per_state, dim=0), noise, k), k=k, noise=noise,
        features=features, state=owner.repeat_interleave(per_state),
    )  # fmt: skip


def joined(parts: Sequence[Noisy]) -> Noisy:
    """All of them as one set."""
    starts = itertools.accumulate((len(p.features) for p in parts[:-1]), initial=0)
    return Noisy(
        chunks=torch.cat([p.chunks for p in parts]), k=torch.cat([p.k for p in parts]),
        noise=torch.cat([p.noise for p in parts]), features=torch.cat([p.features for p in parts]),
        state=torch.cat([p.state + start for p, start in zip(parts, starts, strict=True)]),
    )  # fmt: skip


def denoising_errors(
    denoiser: Trainable, noisy: Noisy, config: FCPAConfig, cancelled: Cancelled, each: Each = in_turn
) -> list[Float[Tensor, "B"]]:
    """‖ε − ε_θ‖² of every row, summed (or averaged) over entries (the arm's alone with `arm_only`), in batches as equal
    as may be, an even number of them. `per_chunk` makes l_diff of them."""
    dims = ARM_DIMS if config.arm_only else noisy.chunks.shape[2]

    def batch(rows: Int[Tensor, "B"]) -> Float[Tensor, "B"]:
        check(cancelled)
        here, row = noisy.state[rows].unique(return_inverse=True)
        condition = denoiser.condition(noisy.features[here]).index_select(0, row)
        predicted = denoiser.run(noisy.chunks[rows], noisy.k[rows], condition)
        squared = (noisy.noise[rows] - predicted)[..., :dims].square().flatten(1)
        return squared.sum(1) if config.reduction == "sum" else squared.mean(1)

    count = min(len(noisy), 2 * math.ceil(len(noisy) / (2 * BATCH)))
    return each(batch, torch.arange(len(noisy)).tensor_split(count)) if count else []


def per_chunk(errors: Float[Tensor, "N*D"], draws: int) -> Float[Tensor, "N"]:
    """l_diff of each chunk: the mean over its draws."""
    return errors.reshape(-1, draws).mean(1)


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
        self, denoiser: Trainable, noising: Noising, pairs: Pairs, config: FCPAConfig, cancelled: Cancelled,
        each: Each = in_turn,
    ) -> None:  # fmt: skip
        """`each` computes the batches of a pass."""
        self.denoiser, self.noising, self.pairs, self.config = denoiser, noising, pairs, config
        self.cancelled, self.each = cancelled, each

    def noised(self, chunks: Tensor, owner: Tensor, states: slice, draws: Draws, asked: bool = True) -> Noisy:
        """These chunks of these states; none of them unless the objective asks for them."""
        here = Draws(k=draws.k[states], noise=draws.noise[states])
        count = len(chunks) if asked else 0
        return noised(self.noising, chunks[:count], self.pairs.features[states], here, owner[:count])

    def errors(self, noisy: Noisy) -> list[Tensor]:
        return denoising_errors(self.denoiser, noisy, self.config, self.cancelled, self.each)

    @torch.no_grad()
    def report(self, draws: Draws, most: int | None = None) -> tuple[float, float, float]:
        """(loss, l⁺, l⁻), each a mean over pairs, on these draws; `most`: of so many pairs a state."""
        pairs, count = self.pairs, draws.k.shape[1]
        rows = slice(None) if most is None else pairs.first(most)
        chunks, owner, weights = pairs.positives[rows], pairs.owner[rows], pairs.weights[rows]
        told = len(chunks)
        if self.config.objective != "awr":
            chunks = torch.cat([chunks, pairs.negatives])
            owner = torch.cat([owner, torch.arange(len(pairs.negatives), device=owner.device)])
        noisy = self.noised(chunks, owner, slice(0, len(pairs.features)), draws)
        errors = per_chunk(torch.cat(self.errors(noisy)), count)
        winner, loser = errors[:told], torch.full_like(errors[:told], math.nan)
        if self.config.objective != "awr":
            loser = errors[told:][owner[:told]]
        loss = preference_loss(winner, loser, self.config, weights) / told
        return float(loss), float(winner.mean()), float(loser.mean())

    def gradient(self, draws: Draws, cloning: Cloning | None = None) -> Float[Tensor, "P"]:
        """The loss's gradient, flat; with that of cloning added."""
        total: list[Tensor] = []
        cloned = [] if cloning is None else [(cloning.weight, self.cloned(cloning))]
        for states, rows in blocks(self.pairs):
            self.gather(states, rows, draws, [total], cloned)
            cloned = []
        return self.denoiser.pull_back(total)

    def gradients(self, draws: Draws) -> tuple[Float[Tensor, "P"], Float[Tensor, "P"]]:
        """(g⁺, g⁻): the loss's gradient through the positives' errors and through the negatives', flat; their sum is
        the gradient of the loss. Following −g⁺ lowers l⁺, following −g⁻ raises l⁻."""
        totals: list[list[Tensor]] = [[], []]
        for states, rows in blocks(self.pairs):
            self.gather(states, rows, draws, totals, [])
        nothing = [torch.zeros_like(leaf) for leaf in self.denoiser.leaves]
        at_winner, at_loser = (self.denoiser.pull_back(total or nothing) for total in totals)
        return at_winner, at_loser

    def gather(
        self, states: slice, rows: slice, draws: Draws, totals: Sequence[list[Tensor]],
        cloned: Sequence[tuple[float, Noisy]],
    ) -> None:  # fmt: skip
        """Add the gradient of these states' part of the loss on the denoiser's leaves: to one sum in one go, or through
        l⁺ to one and through l⁻ to another. With the mean error of `cloned`, times its weight, in the first."""
        pairs, count, objective = self.pairs, draws.k.shape[1], self.config.objective
        owner = pairs.owner[rows] - states.start
        own = torch.arange(states.stop - states.start, device=owner.device)
        wins, loses = objective != "no_positive", objective in {"pairwise", "no_positive"}
        parts = [
            self.noised(pairs.positives[rows], owner, states, draws, asked=wins),
            self.noised(pairs.negatives[states], own, states, draws, asked=loses),
            *(noisy for _, noisy in cloned),
        ]  # fmt: skip
        at_once = len(totals) == 1
        groups = [parts] if at_once else [[part] for part in parts]
        errors = [self.errors(joined(group)) for group in groups]
        found = torch.cat([e.detach() for batches in errors for e in batches]).split([len(p) for p in parts])
        none = torch.zeros(len(owner), device=owner.device)
        winner = (per_chunk(found[0], count) if wins else none).requires_grad_()
        loser = (per_chunk(found[1], count)[owner] if loses else none.clone()).requires_grad_()
        loss = preference_loss(winner, loser, self.config, pairs.weights[rows]) / len(pairs)
        to_winner, to_loser = torch.autograd.grad(loss, (winner, loser), materialize_grads=True)
        to_negative = torch.zeros(len(own), device=owner.device).index_add_(0, owner, to_loser)
        shares = [
            (to_winner / count).repeat_interleave(count)[: len(parts[0])],
            (to_negative / count).repeat_interleave(count)[: len(parts[1])],
            *(noisy.noise.new_full((len(noisy),), weight / len(noisy)) for weight, noisy in cloned),
        ]  # fmt: skip
        grouped = [torch.cat(shares)] if at_once else shares
        for total, batches, share in zip(totals, errors, grouped, strict=True):
            self.accumulate(total, batches, share)

    def accumulate(self, total: list[Tensor], errors: list[Tensor], share: Float[Tensor, "R"]) -> None:
        """Add the gradients of Σ share · error."""
        if not errors:
            return
        weights = share.split([len(e) for e in errors])

        def back(batch: tuple[Tensor, Tensor]) -> tuple[Tensor, ...]:
            check(self.cancelled)
            error, weight = batch
            return torch.autograd.grad(error @ weight, self.denoiser.leaves, materialize_grads=True)

        for gradients in self.each(back, list(zip(errors, weights, strict=True))):
            total[:] = [a + b for a, b in zip(total, gradients, strict=True)] if total else gradients

    def cloned(self, cloning: Cloning) -> Noisy:
        """A minibatch of demonstration chunks."""
        demonstrations, rng = cloning.demonstrations, cloning.rng
        rows = torch.from_numpy(rng.integers(len(demonstrations.chunks), size=BC_BATCH))
        chunks = demonstrations.chunks[rows]
        draws = draw(rng, BC_BATCH, 1, self.noising.steps, chunks)
        own = torch.arange(BC_BATCH, device=chunks.device)
        return noised(self.noising, chunks, demonstrations.features[rows], draws, own)
