"""A failed attempt as arrays: the histories the policy saw, V of every state, the chunks that were sent, the blame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from far_app.config import AttributionConfig
from far_app.learning.attribution import corrected, flag, value_change, without_person
from far_app.learning.cancellation import Cancelled, check
from far_app.learning.critic import Critic
from far_app.learning.memory import Encode, FeatureMemory
from far_app.learning.pairs import Pairs, distance
from far_app.learning.policy import DiffusionPolicy
from far_app.protocols import History
from far_app.types import Adaptation, Attempt, Contrast

HISTORIES_A_PASS = {"cpu": 1, "cuda": 16}
"""Histories encoded between two looks at `cancelled`, by device: on a CPU up to 70 ms for the paper's ResNets."""


def history(attempt: Attempt, tick: int, n_obs: int) -> History:
    """The n_obs observations up to tick t (t = T: the final one), oldest first, the first repeated at the start."""
    seen = [*(s.observation for s in attempt.steps), attempt.final]
    return tuple(seen[max(0, tick - back)] for back in reversed(range(n_obs)))


@dataclass(frozen=True, kw_only=True)
class Eyes:
    """Who looks at an attempt, and what they have seen of it already."""

    policy: DiffusionPolicy
    critic: Critic
    memory: FeatureMemory
    encode: Encode | None = None
    """The policy's encoder where there is a faster form of it than its own."""

    def own(self, attempt: Attempt, ticks: Sequence[int], cancelled: Cancelled) -> Float[Tensor, "S F"]:
        """The policy's features of s_t for these ticks."""
        return self._look(self.policy, self.encode or self.policy.encode, "policy", attempt, ticks, cancelled)

    def critics(self, attempt: Attempt, ticks: Sequence[int], cancelled: Cancelled) -> Float[Tensor, "S F"]:
        """What the critic takes of s_t for these ticks."""
        if self.critic.eyes is None:
            return self.own(attempt, ticks, cancelled)
        return self._look(self.critic.eyes, self.critic.eyes.encode, "critic", attempt, ticks, cancelled)

    def _look(
        self, network: DiffusionPolicy, encode: Encode, eyes: str, attempt: Attempt, ticks: Sequence[int],
        cancelled: Cancelled,
    ) -> Float[Tensor, "S F"]:  # fmt: skip
        """Those not seen before a few at a time."""
        device = next(network.parameters()).device
        a_pass = HISTORIES_A_PASS[device.type]

        def look(histories: Sequence[History]) -> Float[Tensor, "S F"]:
            parts = []
            for first in range(0, len(histories), a_pass):
                check(cancelled)
                parts.append(encode(histories[first : first + a_pass]))
            return torch.cat(parts)

        check(cancelled)
        if not len(ticks):
            return torch.zeros(0, network.feature_dim, device=device)
        return self.memory.of([history(attempt, t, network.config.n_obs) for t in ticks], look, eyes)


def recorded_values(attempt: Attempt) -> Float[np.ndarray, "T+1"]:
    """V(s_0) … V(s_T) as computed while the attempt ran; NaN where that was not in time, and for s_T."""
    return np.array([*(s.value for s in attempt.steps), np.nan])


def values(eyes: Eyes, attempt: Attempt, cancelled: Cancelled) -> Float[np.ndarray, "T+1"]:
    """V(s_0) … V(s_T): recorded where there is a record, computed now where there is none."""
    found = recorded_values(attempt)
    missing = np.flatnonzero(~np.isfinite(found))
    with torch.no_grad():
        found[missing] = eyes.critic.value(eyes.critics(attempt, missing.tolist(), cancelled)).cpu().numpy()
    return found


def unlearnt(attempt: Attempt, version: str, horizon: int) -> Adaptation:
    """What is known of a failure before anything was learnt from it."""
    found = recorded_values(attempt)
    return Adaptation(
        status="none", base_version=version, version=version, values=found,
        value_changes=value_change(found, horizon), threshold=math.nan, flagged=(),
    )  # fmt: skip


def attributed(
    adaptation: Adaptation, attempt: Attempt, eyes: Eyes, config: AttributionConfig, cancelled: Cancelled
) -> Adaptation:
    """The adaptation with every V, every ΔV, and the chunks to blame."""
    found = values(eyes, attempt, cancelled)
    horizon = eyes.policy.config.horizon
    changes = value_change(found, horizon)
    person = np.array([step.intervention for step in attempt.steps], bool)
    flags = flag(without_person(changes, person, horizon), config)
    return replace(
        adaptation, values=found, value_changes=changes, threshold=flags.threshold, corrections=attempt.corrections,
        flagged=corrected(flags.ticks, attempt.corrections, len(changes)),
    )  # fmt: skip


def contrasts(
    pairs: Pairs, ticks: Sequence[int], shown: Float[Tensor, "S F"], critic: Critic, arm_only: bool
) -> tuple[Contrast, ...]:
    """Each flagged chunk that has positives beside them, for people: Q and distance, best Q first."""
    found = []
    for row, state in enumerate(pairs.kept):
        positives, negative = pairs.positives[pairs.owner == row], pairs.negatives[row : row + 1]
        seen_here = shown[state : state + 1]
        q = critic.q(seen_here.expand(len(positives), -1), positives)
        order = q.argsort(descending=True)
        apart = distance(positives[None], negative, arm_only)[0]
        found.append(Contrast(
            tick=int(ticks[state]), negative_q=float(critic.q(seen_here, negative)),
            positives=positives[order].cpu().numpy(), q=q[order].cpu().numpy(), distance=apart[order].cpu().numpy(),
        ))  # fmt: skip
    return tuple(found)


def sent_chunks(attempt: Attempt, ticks: Sequence[int], horizon: int) -> Float[np.ndarray, "S H A"]:
    """a_{t:t+H−1} as sent to the arm, in [−1, 1]; the commanded action where no acknowledgment came."""
    actions = np.stack([np.where(np.isfinite(s.sent), s.sent, s.commanded) for s in attempt.steps])
    index = np.asarray(ticks, int)[:, None] + np.arange(horizon)
    return np.clip(actions[index], -1.0, 1.0).astype(np.float32)
