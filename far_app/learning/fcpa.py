"""Failure-Contrastive Preference Adaptation: a few gradient steps that prefer the positives to the sent chunks.

    l_diff(a, s; θ) = E_{k,ε} ‖ε − ε_θ(a_k, s, k)‖²
    L_pref          = − log σ( β [ l_diff(a⁻, s; θ) − l_diff(a⁺, s; θ) ] )          (paper, Eq. preference)

averaged over all pairs in every step. The expectation is a mean over a few draws (k, ε), k stratified over the
diffusion steps, the same draws for a state's negative and all its positives. Only the denoiser's weights move; the
encoder is frozen and its features cached. The printed loss can raise l⁺ together with l⁻; FCPAConfig.guard offers
remedies. Called by far_app/methods with a private copy of the denoiser.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from far_app.config import FCPAConfig
from far_app.errors import ConfigError, PolicyError
from far_app.learning.adamw import FlatAdamW, guarded_step
from far_app.learning.cancellation import Cancelled, check
from far_app.learning.pairs import BATCH, Pairs
from far_app.learning.trainable import Trainable, trainable
from far_app.types import AdaptationStep

AddNoise = Callable[[Float[Tensor, "B H A"], Float[Tensor, "B H A"], Int[Tensor, "B"]], Float[Tensor, "B H A"]]
"""a_k from (a, ε, k)."""
FIXED_DRAWS = 2
"""Draws a state for the reported l⁺ and l⁻; the same before the first and after every step."""
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
class Draws:
    """D draws of (k, ε) for each of S states."""

    k: Int[Tensor, "S D"]
    noise: Float[Tensor, "S D H A"]


@dataclass(frozen=True, kw_only=True)
class Update:
    """How an update went. The denoiser then holds the adapted weights, or its old ones when `changed` is False."""

    status: str
    """"adapted", "stopped" (a guard ended it) or "failed" (a loss or gradient was not finite)."""
    changed: bool
    history: tuple[AdaptationStep, ...]
    note: str = ""


def draw(rng: np.random.Generator, states: int, draws: int, diffusion_steps: int, chunk: tuple[int, int]) -> Draws:
    """Fresh draws; k stratified: a state's D draws fall one into each of D equal ranges, and within a range the states
    are spread evenly too."""
    spread = np.stack([rng.permutation(states) for _ in range(draws)], axis=1) + rng.random((states, draws))
    k = ((np.arange(draws) + spread / states) / draws * diffusion_steps).astype(np.int64)
    noise = rng.standard_normal((states, draws, *chunk), dtype=np.float32)
    return Draws(k=torch.from_numpy(k.clip(max=diffusion_steps - 1)), noise=torch.from_numpy(noise))


def denoising_errors(
    denoiser: Trainable,
    noising: Noising,
    chunks: Float[Tensor, "N H A"],
    features: Float[Tensor, "S F"],
    draws: Draws,
    owner: Int[Tensor, "N"],
    reduction: str,
    cancelled: Cancelled,
) -> list[Float[Tensor, "B"]]:
    """Squared error, summed (or averaged) over entries, of every draw of every chunk in its owner's state: N · D rows,
    a chunk's draws side by side, in batches. `per_chunk` makes l_diff of them."""
    per_state = draws.k.shape[1]
    state = owner.repeat_interleave(per_state)
    k, noise = draws.k[owner].flatten(), draws.noise[owner].flatten(0, 1)
    noisy = noising.add_noise(chunks.repeat_interleave(per_state, dim=0), noise, k)
    errors = []
    for rows in torch.arange(len(noisy)).split(BATCH):
        check(cancelled)
        here, row = state[rows].unique(return_inverse=True)
        predicted = denoiser.run(noisy[rows], k[rows], denoiser.condition(features[here])[row])
        squared = (noise[rows] - predicted).square().flatten(1)
        errors.append(squared.sum(1) if reduction == "sum" else squared.mean(1))
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


class _Objective:
    """The preference loss of one set of pairs: its value on fixed draws, its gradients on fresh ones."""

    def __init__(
        self, denoiser: Trainable, noising: Noising, pairs: Pairs, config: FCPAConfig, cancelled: Cancelled
    ) -> None:
        self.denoiser, self.noising, self.pairs, self.config = denoiser, noising, pairs, config
        self.cancelled = cancelled

    def errors(self, chunks: Tensor, owner: Tensor, states: slice, draws: Draws) -> list[Tensor]:
        here = Draws(k=draws.k[states], noise=draws.noise[states])
        return denoising_errors(
            self.denoiser, self.noising, chunks, self.pairs.features[states], here, owner, self.config.reduction,
            self.cancelled,
        )  # fmt: skip

    @torch.no_grad()
    def report(self, draws: Draws) -> tuple[float, float, float]:
        """(loss, l⁺, l⁻), each a mean over pairs, on these draws."""
        pairs, count = self.pairs, draws.k.shape[1]
        everything = slice(0, len(pairs.features))
        winner = per_chunk(self.errors(pairs.positives, pairs.owner, everything, draws), count)
        loser = torch.full_like(winner, math.nan)
        if self.config.objective != "awr":
            own = torch.arange(len(pairs.negatives))
            loser = per_chunk(self.errors(pairs.negatives, own, everything, draws), count)[pairs.owner]
        loss = preference_loss(winner, loser, self.config, pairs.weights) / len(pairs)
        return float(loss), float(winner.mean()), float(loser.mean())

    def gradients(self, draws: Draws) -> tuple[Float[Tensor, "P"], Float[Tensor, "P"]]:
        """(g⁺, g⁻): the loss's gradient through the positives' errors and through the negatives', flat; their sum is
        the gradient of the loss. Following −g⁺ lowers l⁺, following −g⁻ raises l⁻."""
        count, objective = draws.k.shape[1], self.config.objective
        totals = {side: [torch.zeros_like(leaf) for leaf in self.denoiser.leaves] for side in ("winner", "loser")}
        for states, rows in blocks(self.pairs):
            owner = self.pairs.owner[rows] - states.start
            own = torch.arange(states.stop - states.start)
            winners, losers = [], []
            winner = loser = torch.zeros(len(owner))
            if objective != "no_positive":
                winners = self.errors(self.pairs.positives[rows], owner, states, draws)
                winner = per_chunk(winners, count)
            if objective in {"pairwise", "no_positive"}:
                losers = self.errors(self.pairs.negatives[states], own, states, draws)
                loser = per_chunk(losers, count)[owner]
            at = winner.requires_grad_(), loser.clone().requires_grad_()
            loss = preference_loss(*at, self.config, self.pairs.weights[rows]) / len(self.pairs)
            to_winner, to_loser = torch.autograd.grad(loss, at, materialize_grads=True)
            self.accumulate(totals["winner"], winners, to_winner, count)
            self.accumulate(totals["loser"], losers, torch.zeros(len(own)).index_add_(0, owner, to_loser), count)
        return self.denoiser.pull_back(totals["winner"]), self.denoiser.pull_back(totals["loser"])

    def accumulate(self, totals: list[Tensor], errors: list[Tensor], share: Float[Tensor, "N"], draws: int) -> None:
        """Add the gradients of Σ share · l_diff, batch by batch."""
        for error, weight in zip(errors, (share / draws).repeat_interleave(draws).split(BATCH), strict=False):
            check(self.cancelled)
            gradients = torch.autograd.grad((error * weight).sum(), self.denoiser.leaves, materialize_grads=True)
            for total, gradient in zip(totals, gradients, strict=True):
                total.add_(gradient)

    def cloning_gradient(self, demonstrations: Demonstrations, rng: np.random.Generator) -> Float[Tensor, "P"]:
        """Gradient of the behaviour-cloning loss on a minibatch of demonstration chunks."""
        rows = torch.from_numpy(rng.integers(len(demonstrations.chunks), size=BC_BATCH))
        chunks = demonstrations.chunks[rows]
        draws = draw(rng, BC_BATCH, 1, self.noising.steps, (chunks.shape[1], chunks.shape[2]))
        errors = denoising_errors(
            self.denoiser, self.noising, chunks, demonstrations.features[rows], draws, torch.arange(BC_BATCH),
            self.config.reduction, self.cancelled,
        )  # fmt: skip
        totals = [torch.zeros_like(leaf) for leaf in self.denoiser.leaves]
        self.accumulate(totals, errors, torch.full((BC_BATCH,), 1 / BC_BATCH), 1)
        return self.denoiser.pull_back(totals)


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
) -> Update:
    """FCPA on these pairs, in place; `denoiser` is the caller's private copy of the weights that acted, in eval mode.
    Progress is told before the first step (step 0) and after each. Raises AdaptationCancelledError on cancellation;
    the copy is then of no use."""
    check_config(config, demonstrations)
    chunk = (pairs.negatives.shape[1], pairs.negatives.shape[2])
    runner = trainable(denoiser, horizon=chunk[0])
    objective = _Objective(runner, noising, pairs, config, cancelled)
    states = len(pairs.features)
    fixed = draw(rng, states, FIXED_DRAWS, noising.steps, chunk)
    optimiser = FlatAdamW(runner.parameters, lr=config.lr)
    start = optimiser.weights()
    history: list[AdaptationStep] = []

    def report(step: int) -> AdaptationStep:
        loss, winner, loser = objective.report(fixed)
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
            before = optimiser.weights()
            g_winner, g_loser = objective.gradients(draw(rng, states, config.draws, noising.steps, chunk))
            if config.guard == "bc" and demonstrations is not None:
                g_winner = g_winner + config.bc_weight * objective.cloning_gradient(demonstrations, rng)
            if config.guard == "scale":
                guarded_step(optimiser, g_winner, g_loser)
            else:
                optimiser.step(g_winner + g_loser)
            runner.refresh()
            winner = report(step).winner_error
            if config.guard in {"stop", "scale"} and winner > limit:
                optimiser.set_weights(before)
                note = f"step {step} raised l⁺ to {winner:.3g}, above {limit:.3g}; it was undone"
                return Update(status="stopped", changed=step > 1, history=tuple(history), note=note)
    except PolicyError as error:
        optimiser.set_weights(start)
        return Update(status="failed", changed=False, history=tuple(history), note=str(error))
    return Update(status="adapted", changed=config.steps > 0, history=tuple(history))
