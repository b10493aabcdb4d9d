"""Acting otherwise without other weights: which of several sampled chunks acts, or a push during denoising.

Used by far_app/methods/{bgr,rerank,negative_guidance}.py, which update nothing, and fcpa_rerank.py, which does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from far_app.learning.critic import Critic
from far_app.types import ACTION_DIM, ARM_DIMS


class Steering(Protocol):
    """Asked by the acting policy, one state at a time."""

    @property
    def samples(self) -> int:
        """N, chunks to draw where it applies; the first is the one the policy would have taken."""
        ...

    def applies(self, features: Float[Tensor, "F"]) -> bool:
        """Whether this state is one to act otherwise in."""
        ...

    def push(self, features: Float[Tensor, "F"], clean: Float[Tensor, "N H A"]) -> Float[Tensor, "N H A"]:
        """The estimate of the clean chunks after a denoising step, pushed."""
        ...

    def pick(self, features: Float[Tensor, "F"], shown: Float[Tensor, "G"], chunks: Float[Tensor, "N H A"]) -> int:
        """The chunk that acts; `shown` is what the critic takes for this state."""
        ...


def more_noise(noise: Float[np.ndarray, "H A"], count: int) -> Float[np.ndarray, "N H A"]:
    """This noise and count − 1 others that follow from it, so that runs repeat."""
    rng = np.random.default_rng(np.ascontiguousarray(noise, np.float32).view(np.uint32).ravel())
    return np.concatenate([noise[None], rng.standard_normal((count - 1, *noise.shape), dtype=np.float32)])


@dataclass(frozen=True, kw_only=True)
class Memory:
    """Failed states and the chunks that were sent in them."""

    features: Float[Tensor, "S F"]
    chunks: Float[Tensor, "S H A"]

    @classmethod
    def empty(cls, feature_dim: int, horizon: int) -> Memory:
        return cls(features=torch.zeros(0, feature_dim), chunks=torch.zeros(0, horizon, ACTION_DIM))

    def __len__(self) -> int:
        return len(self.features)

    def grown(self, features: Float[Tensor, "S F"], chunks: Float[Tensor, "S H A"]) -> Memory:
        """With these too."""
        device = features.device
        return Memory(
            features=torch.cat([self.features.to(device), features]), chunks=torch.cat([self.chunks.to(device), chunks])
        )

    def nearest(self, features: Float[Tensor, "F"]) -> tuple[int, float]:
        """The closest failed state and its L2 distance in feature space; (−1, inf) when nothing is remembered."""
        if not len(self):
            return -1, math.inf
        distances = (self.features - features).norm(dim=1)
        index = int(distances.argmin())
        return index, float(distances[index])


@dataclass(frozen=True, kw_only=True)
class Farthest:
    """Near a failed state, of N chunks the one farthest from what failed there (paper, Baselines: DP-BGR)."""

    memory: Memory
    radius: float
    samples: int

    def applies(self, features: Float[Tensor, "F"]) -> bool:
        return self.memory.nearest(features)[1] < self.radius

    def push(self, features: Float[Tensor, "F"], clean: Float[Tensor, "N H A"]) -> Float[Tensor, "N H A"]:
        return clean

    def pick(self, features: Float[Tensor, "F"], shown: Float[Tensor, "G"], chunks: Float[Tensor, "N H A"]) -> int:
        failed = self.memory.chunks[self.memory.nearest(features)[0]]
        return int((chunks - failed)[..., :ARM_DIMS].flatten(1).norm(dim=1).argmax())


@dataclass(frozen=True, kw_only=True)
class Repelled:
    """Near a failed state, denoising is pushed away from what failed there:

        â_0 ← â_0 + w (â_0 − a⁻) / ‖â_0 − a⁻‖       over the arm's entries, at every denoising step
    """  # fmt: skip

    memory: Memory
    radius: float
    strength: float
    """w, action units over the whole chunk."""
    samples: int = 1

    def applies(self, features: Float[Tensor, "F"]) -> bool:
        return self.memory.nearest(features)[1] < self.radius

    def push(self, features: Float[Tensor, "F"], clean: Float[Tensor, "N H A"]) -> Float[Tensor, "N H A"]:
        away = clean - self.memory.chunks[self.memory.nearest(features)[0]]
        away[..., ARM_DIMS:] = 0
        length = away.flatten(1).norm(dim=1).clamp(min=1e-6)[:, None, None]
        return clean + self.strength * away / length

    def pick(self, features: Float[Tensor, "F"], shown: Float[Tensor, "G"], chunks: Float[Tensor, "N H A"]) -> int:
        return 0


@dataclass(frozen=True, kw_only=True)
class BestOf:
    """In every state, of N chunks the one with the highest Q."""

    critic: Critic
    samples: int

    def applies(self, features: Float[Tensor, "F"]) -> bool:
        return True

    def push(self, features: Float[Tensor, "F"], clean: Float[Tensor, "N H A"]) -> Float[Tensor, "N H A"]:
        return clean

    def pick(self, features: Float[Tensor, "F"], shown: Float[Tensor, "G"], chunks: Float[Tensor, "N H A"]) -> int:
        with torch.no_grad():
            return int(self.critic.q(shown.expand(len(chunks), -1), chunks).argmax())
