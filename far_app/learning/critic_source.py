"""Where a critic's batches come from: features computed once (the policy's encoder), or pictures (an own encoder)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor
from tqdm import tqdm

from far_app.errors import ConfigError
from far_app.learning.critic import Critic
from far_app.learning.dataset import Episode
from far_app.learning.policy import DiffusionPolicy
from far_app.learning.segments import segment_features
from far_app.learning.state import states_of
from far_app.learning.transitions import Backup, EncodedEpisode, RewardKind, Transitions, joined, transitions

Batch = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Features (B, F), chunks (B, H, A), rewards (B,), next features (B, F), discounts (B,)."""


class Source(Protocol):
    def __len__(self) -> int:
        """N transitions."""
        ...

    def batch(self, critic: Critic, rows: Int[np.ndarray, "B"]) -> Batch: ...


def encoded(policy: DiffusionPolicy, episode: Episode, ticks_at_once: int = 64) -> EncodedEpisode:
    """An episode of N observed ticks as N − 1 transitions: a reward and a success belong to the action before them."""
    n_obs, ticks = policy.config.n_obs, len(episode)
    parts, states = [], states_of(episode, policy.config.objects)
    for start in range(0, ticks, ticks_at_once):
        end = min(start + ticks_at_once, ticks)
        frames = np.clip(np.arange(start - n_obs + 1, end), 0, None)
        images = {c: torch.from_numpy(episode.images[c][frames])[None] for c in policy.config.cameras}
        with torch.no_grad():
            parts.append(segment_features(policy, images, torch.from_numpy(states[frames])[None]).numpy())
    return with_features(episode, np.concatenate(parts))


def with_features(episode: Episode, features: np.ndarray) -> EncodedEpisode:
    return EncodedEpisode(
        features=features, actions=episode.actions[:-1], rewards=episode.rewards[1:], success=episode.successes[1:]
    )


class Features:
    """Transitions whose features stay what they are."""

    def __init__(self, data: Transitions) -> None:
        if not len(data):
            raise ConfigError("no transitions to train a critic on")
        arrays = (data.features, data.chunks, data.rewards, data.next_features, data.discounts)
        self.features, self.chunks, self.rewards, self.next_features, self.discounts = (
            torch.from_numpy(np.ascontiguousarray(a)) for a in arrays
        )

    def __len__(self) -> int:
        return len(self.rewards)

    def batch(self, critic: Critic, rows: Int[np.ndarray, "B"]) -> Batch:
        at = torch.from_numpy(rows)
        return self.features[at], self.chunks[at], self.rewards[at], self.next_features[at], self.discounts[at]


class Pictures:
    """Transitions seen through the critic's own eyes, gradients included; all pictures are held in memory."""

    def __init__(self, episodes: Sequence[Episode], horizon: int, reward: RewardKind, backup: Backup) -> None:
        starts = np.cumsum([0, *(len(e) for e in episodes)])
        self.first = np.repeat(starts[:-1], [len(e) for e in episodes])
        """Row of the first tick of each row's episode."""
        self.images = {c: np.concatenate([e.images[c] for e in episodes]) for c in episodes[0].images}
        self.states = np.concatenate([e.states for e in episodes])
        numbered = [
            transitions(with_features(e, np.arange(start, start + len(e))[:, None]), horizon, reward, backup)
            for e, start in zip(episodes, starts[:-1], strict=True)
            if len(e) > 1
        ]
        self.table = Features(joined(numbered))
        """Transitions whose features are the row numbers of s_t and s_{t+n}."""

    def __len__(self) -> int:
        return len(self.table)

    def batch(self, critic: Critic, rows: Int[np.ndarray, "B"]) -> Batch:
        assert critic.eyes is not None, "pictures need a critic with eyes"
        now, chunks, rewards, later, discounts = self.table.batch(critic, rows)
        return self._seen(critic.eyes, now), chunks, rewards, self._seen(critic.eyes, later), discounts

    def _seen(self, eyes: DiffusionPolicy, numbers: Tensor) -> Tensor:
        at = numbers[:, 0].long().numpy()
        frames = np.maximum(at[:, None] + np.arange(1 - eyes.config.n_obs, 1), self.first[at][:, None])
        images = {c: torch.from_numpy(self.images[c][frames]) for c in eyes.config.cameras}
        return segment_features(eyes, images, torch.from_numpy(self.states[frames]))


def policy_features(
    policy: DiffusionPolicy,
    demonstrations: Sequence[Episode],
    attempts: Sequence[Episode],
    reward: RewardKind,
    backup: Backup,
) -> tuple[Transitions, int]:
    """D_exp ∪ D_succ ∪ D_fail through the policy's encoder, and how many of the first rows are demonstrations."""
    if not demonstrations:
        raise ConfigError("no demonstrations to train a critic on; make some with `far demo`")
    episodes = tqdm([*demonstrations, *attempts], unit="episode", desc="features", leave=False)
    parts = [transitions(encoded(policy, e), policy.config.horizon, reward, backup) for e in episodes if len(e) > 1]
    shown = sum(len(p) for p in parts[: sum(len(e) > 1 for e in demonstrations)])
    return joined(parts), shown
