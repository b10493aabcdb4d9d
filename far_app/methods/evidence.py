"""A failed attempt as arrays: the histories the policy saw, V of every state, the chunks that were sent, the blame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from far_app.config import AttributionConfig
from far_app.learning.attribution import corrected, flag, value_change, without_person
from far_app.learning.cancellation import Cancelled, check
from far_app.learning.critic import Critic
from far_app.learning.pairs import Pairs, distance
from far_app.learning.policy import DiffusionPolicy
from far_app.protocols import History
from far_app.types import Adaptation, Attempt, Contrast

HISTORIES_A_PASS = 4
"""Histories encoded between two looks at `cancelled`: a few ms for a light encoder, some 100 ms for ResNets."""


def history(attempt: Attempt, tick: int, n_obs: int) -> History:
    """The n_obs observations up to tick t (t = T: the final one), oldest first, the first repeated at the start."""
    seen = [*(s.observation for s in attempt.steps), attempt.final]
    return tuple(seen[max(0, tick - back)] for back in reversed(range(n_obs)))


def seen(
    policy: DiffusionPolicy, critic: Critic, attempt: Attempt, ticks: Sequence[int], cancelled: Cancelled
) -> tuple[Float[Tensor, "S F"], Float[Tensor, "S F"]]:
    """Of s_t for these ticks: the policy's features, and what the critic takes."""
    own = features(policy, attempt, ticks, cancelled)
    if critic.eyes is None:
        return own, own
    return own, features(critic.eyes, attempt, ticks, cancelled)


def features(
    policy: DiffusionPolicy, attempt: Attempt, ticks: Sequence[int], cancelled: Cancelled
) -> Float[Tensor, "S F"]:
    """Encoder features of s_t for these ticks."""
    parts = [torch.zeros(0, policy.feature_dim, device=next(policy.parameters()).device)]
    for first in range(0, len(ticks), HISTORIES_A_PASS):
        check(cancelled)
        some = ticks[first : first + HISTORIES_A_PASS]
        parts.append(policy.encode([history(attempt, t, policy.config.n_obs) for t in some]))
    return torch.cat(parts)


def recorded_values(attempt: Attempt) -> Float[np.ndarray, "T+1"]:
    """V(s_0) … V(s_T) as computed while the attempt ran; NaN where that was not in time, and for s_T."""
    return np.array([*(s.value for s in attempt.steps), np.nan])


def values(policy: DiffusionPolicy, critic: Critic, attempt: Attempt, cancelled: Cancelled) -> Float[np.ndarray, "T+1"]:
    """V(s_0) … V(s_T): recorded where there is a record, computed now where there is none."""
    found = recorded_values(attempt)
    missing = np.flatnonzero(~np.isfinite(found))
    with torch.no_grad():
        shown = features(critic.eyes or policy, attempt, missing.tolist(), cancelled)
        found[missing] = critic.value(shown).cpu().numpy()
    return found


def unlearnt(attempt: Attempt, version: str, horizon: int) -> Adaptation:
    """What is known of a failure before anything was learnt from it."""
    found = recorded_values(attempt)
    return Adaptation(
        status="none", base_version=version, version=version, values=found,
        value_changes=value_change(found, horizon), threshold=math.nan, flagged=(),
    )  # fmt: skip


def attributed(
    adaptation: Adaptation, attempt: Attempt, policy: DiffusionPolicy, critic: Critic, config: AttributionConfig,
    cancelled: Cancelled,
) -> Adaptation:  # fmt: skip
    """The adaptation with every V, every ΔV, and the chunks to blame."""
    found = values(policy, critic, attempt, cancelled)
    changes = value_change(found, policy.config.horizon)
    person = np.array([step.intervention for step in attempt.steps], bool)
    flags = flag(without_person(changes, person, policy.config.horizon), config)
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
