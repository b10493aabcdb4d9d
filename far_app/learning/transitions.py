"""Episodes as IQL transitions, in plain arrays: (features, chunk, reward, next features, discount), over n ticks.

Rewards are labelled here, by kind:
    shaped   r − 1 from the environment's shaped reward in [0, 1]: in [−1, 0], 0 at completion
    sparse   3 at completion, else 0                               (paper, Reward Type)
    real     −0.1 before completion, 3 at completion               (paper, Real-world Experiments)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

RewardKind = Literal["shaped", "sparse", "real"]


@dataclass(frozen=True, kw_only=True)
class EncodedEpisode:
    """A demonstration, or an attempt of the policy, through the eyes of a frozen encoder."""

    features: Float[np.ndarray, "T+1 F"]
    """Of s_0 … s_T, float32."""
    actions: Float[np.ndarray, "T A"]
    """Executed, ã_t."""
    rewards: Float[np.ndarray, "T"]
    """The environment's shaped reward in [0, 1] after each action."""
    success: Bool[np.ndarray, "T"]
    """Whether the task was complete after each action; all False for a failed attempt."""


@dataclass(frozen=True, kw_only=True)
class Transitions:
    """N transitions, float32."""

    features: Float[np.ndarray, "N F"]
    chunks: Float[np.ndarray, "N H A"]
    rewards: Float[np.ndarray, "N"]
    """Σ_{i<n} γ^i r_{t+i}."""
    next_features: Float[np.ndarray, "N F"]
    """Of s_{t+n}."""
    discounts: Float[np.ndarray, "N"]
    """γ^n; 0 where the task was completed within those n ticks."""

    def __len__(self) -> int:
        return len(self.rewards)


def labelled(kind: RewardKind, shaped: Float[np.ndarray, "T"], success: Bool[np.ndarray, "T"]) -> np.ndarray:
    """Rewards of one episode, by kind."""
    if kind == "shaped":
        return np.where(success, 0.0, shaped - 1.0)
    return np.where(success, 3.0, 0.0 if kind == "sparse" else -0.1)


def chunked(actions: Float[np.ndarray, "T A"], horizon: int) -> Float[np.ndarray, "T H A"]:
    """a_{t:t+H−1} for every t; past the end the last action repeats."""
    steps = len(actions)
    index = np.minimum(np.arange(steps)[:, None] + np.arange(horizon), steps - 1)
    return actions[index]


@dataclass(frozen=True, kw_only=True)
class Backup:
    """How far Q's target looks ahead before it asks V."""

    ticks: int = 1
    """n; fewer at an episode's end. 1 is the paper's (its Eq. for Q)."""
    gamma: float = 0.99
    """γ, one tick."""


def transitions(episode: EncodedEpisode, horizon: int, kind: RewardKind, backup: Backup) -> Transitions:
    """One episode's transitions, up to its completion if it has one: what follows success is nobody's business."""
    steps = len(episode.actions)
    first = int(np.argmax(episode.success)) + 1 if episode.success.any() else steps
    chunks = chunked(episode.actions, horizon)[:first]
    rewards = labelled(kind, episode.rewards, episode.success)[:first]
    padded = np.append(rewards, np.zeros(backup.ticks))
    gained = sum((backup.gamma**i * padded[i : i + first] for i in range(backup.ticks)), np.zeros(first))
    ends = np.minimum(np.arange(first) + backup.ticks, first)
    discounts = np.where(episode.success[ends - 1], 0.0, backup.gamma ** (ends - np.arange(first)))
    return Transitions(
        features=episode.features[:first].astype(np.float32), chunks=chunks.astype(np.float32),
        rewards=gained.astype(np.float32),
        next_features=episode.features[ends].astype(np.float32),
        discounts=discounts.astype(np.float32),
    )  # fmt: skip


def joined(parts: Sequence[Transitions]) -> Transitions:
    return Transitions(
        features=np.concatenate([p.features for p in parts]),
        chunks=np.concatenate([p.chunks for p in parts]),
        rewards=np.concatenate([p.rewards for p in parts]),
        next_features=np.concatenate([p.next_features for p in parts]),
        discounts=np.concatenate([p.discounts for p in parts]),
    )
