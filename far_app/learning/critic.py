"""V(s) and Q(s, a): implicit Q-learning on the policy's features (paper, Conservative Value Estimation).

    L_V = E[ L₂^τ( min Q̄(s, a) − V(s) ) ],      L₂^τ(u) = |τ − 1(u < 0)| u²
    L_Q = E[ ( R + γ^n (1 − done) V(s_{t+n}) − Q(s, a) )² ],      a = a_{t:t+H−1}, R = Σ_{i<n} γ^i r_{t+i}
    Q̄  ← (1 − ρ) Q̄ + ρ Q

n = 1 is the paper's; n = H looks at what the whole chunk led to. V is one MLP, Q two on [features, flattened chunk];
done means success, never the time limit. Trained by
train_critic.py; used for V(s_t) in every tick, for ΔV and for TopK.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from far_app.learning.memory import FeatureMemory
from far_app.learning.policy import DiffusionPolicy
from far_app.protocols import History


@dataclass(frozen=True, kw_only=True)
class CriticShape:
    """What a critic's weights fit; saved with them and compared when they are loaded."""

    features: int
    """F, size of the encoder's features."""
    horizon: int
    """H."""
    action_dim: int
    """A."""
    hidden: tuple[int, ...] = (256, 256)
    own_eyes: bool = False
    """Sees through an encoder of its own (the paper's form), not through the policy's."""


def eyes_of(policy: DiffusionPolicy) -> DiffusionPolicy:
    """A copy of everything in the policy between observation and features."""
    eyes = copy.deepcopy(policy)
    del eyes.denoiser
    return eyes


def mlp(inputs: int, hidden: tuple[int, ...], outputs: int) -> nn.Sequential:
    sizes = (inputs, *hidden)
    layers = [m for a, b in itertools.pairwise(sizes) for m in (nn.Linear(a, b), nn.ReLU())]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs))


class Critic(nn.Module):
    """V head, twin Q heads and their slow copies, on features standardised by fixed statistics.

    The features are the policy's own, or those of `eyes`: an encoder that began as a copy of the policy's and was
    trained further."""

    mean: Tensor
    std: Tensor

    def __init__(self, shape: CriticShape, eyes: DiffusionPolicy | None = None) -> None:
        super().__init__()
        self.shape = shape
        self.eyes = eyes
        chunk = shape.horizon * shape.action_dim
        self.v = mlp(shape.features, shape.hidden, 1)
        self.q1 = mlp(shape.features + chunk, shape.hidden, 1)
        self.q2 = mlp(shape.features + chunk, shape.hidden, 1)
        self.slow_q1 = copy.deepcopy(self.q1).requires_grad_(False)
        self.slow_q2 = copy.deepcopy(self.q2).requires_grad_(False)
        self.register_buffer("mean", torch.zeros(shape.features))
        self.register_buffer("std", torch.ones(shape.features))

    def see(
        self, histories: Sequence[History], features: Float[Tensor, "B F"], memory: FeatureMemory
    ) -> Float[Tensor, "B F"]:
        """What `value` and `q` take, from histories and the policy's features of them."""
        eyes = self.eyes
        if eyes is None:
            return features
        return memory.of(histories, lambda new: torch.cat([eyes.encode([h]) for h in new]), eyes="critic")

    def standardise(self, features: Float[Tensor, "N F"]) -> None:
        """Fix the input statistics, before training; entries that hardly vary are left unscaled."""
        self.mean.copy_(features.mean(0))
        std = features.std(0)
        self.std.copy_(torch.where(std > 1e-4, std, torch.ones_like(std)))

    def value(self, features: Float[Tensor, "B F"]) -> Float[Tensor, "B"]:
        """V(s): discounted reward to come, in reward units."""
        return self.v((features - self.mean) / self.std).squeeze(-1)

    def twin_q(
        self, features: Float[Tensor, "B F"], chunks: Float[Tensor, "B H A"], slow: bool = False
    ) -> tuple[Float[Tensor, "B"], Float[Tensor, "B"]]:
        """(Q₁, Q₂), or the target networks' when slow."""
        inputs = torch.cat([(features - self.mean) / self.std, chunks.flatten(1)], dim=1)
        first, second = (self.slow_q1, self.slow_q2) if slow else (self.q1, self.q2)
        return first(inputs).squeeze(-1), second(inputs).squeeze(-1)

    def q(self, features: Float[Tensor, "B F"], chunks: Float[Tensor, "B H A"]) -> Float[Tensor, "B"]:
        """The smaller of the twins, which ranks candidates."""
        return torch.minimum(*self.twin_q(features, chunks))

    @torch.no_grad()
    def follow(self, rate: float) -> None:
        """Polyak step of the slow copies towards the twins."""
        for slow, fast in ((self.slow_q1, self.q1), (self.slow_q2, self.q2)):
            for s, f in zip(slow.parameters(), fast.parameters(), strict=True):
                s.lerp_(f, rate)


def expectile_loss(u: Float[Tensor, "B"], tau: float) -> Float[Tensor, ""]:
    """Mean of L₂^τ(u) = |τ − 1(u < 0)| u²."""
    return (torch.abs(tau - (u < 0).to(u.dtype)) * u.square()).mean()


def iql_losses(
    critic: Critic,
    features: Float[Tensor, "B F"],
    chunks: Float[Tensor, "B H A"],
    rewards: Float[Tensor, "B"],
    next_features: Float[Tensor, "B F"],
    discounts: Float[Tensor, "B"],
    tau: float,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """(L_V, L_Q) of a batch; discounts are γ^n, 0 where the task was completed within those n ticks."""
    with torch.no_grad():
        slow = torch.minimum(*critic.twin_q(features, chunks, slow=True))
        target = rewards + discounts * critic.value(next_features)
    value_loss = expectile_loss(slow - critic.value(features), tau)
    q1, q2 = critic.twin_q(features, chunks)
    return value_loss, (target - q1).square().mean() + (target - q2).square().mean()
