"""Retries that act otherwise without learning: the shared part of bgr, rerank and negative-guidance.

A failure is attributed as FAR attributes it; the flagged states with their sent chunks go into the trial's memory, from
which a Steering for the acting policy is made. The weights never change, and the first attempt is the base policy's.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from far_app.errors import ConfigError, FarError
from far_app.learning.attribution import flag, value_change
from far_app.learning.cancellation import AdaptationCancelledError, Cancelled, check
from far_app.learning.critic import Critic
from far_app.learning.steering import Memory, Steering
from far_app.methods import evidence
from far_app.methods.retry import BASE_VERSION, Ingredients
from far_app.perturbation import Perturbation
from far_app.protocols import Progress
from far_app.types import ACTION_DIM, Adaptation, Attempt

Remedy = Callable[[Memory, Critic], Steering]
"""How to act from now on, given what failed."""


class ResamplingMethod:
    """far_app.protocols.Method."""

    def __init__(self, name: str, ingredients: Ingredients, remedy: Remedy) -> None:
        if ingredients.critic is None:
            raise ConfigError(f"method '{name}' needs a critic; train one with `far train critic`, or use nr")
        self.name = name
        self.network, self.critic, self.config = ingredients.network, ingredients.critic, ingredients.config
        self._act, self._remedy = ingredients.act, remedy
        self._radius = radius(ingredients)
        self._swap = threading.Lock()
        self._base = self._act(self.network, BASE_VERSION)
        self.begin(0)

    def begin(self, scene_seed: int) -> None:
        with self._swap:
            self.policy, self._rounds = self._base, 0
            self._trial = object()
            self.memory = Memory(
                features=torch.zeros(0, self.network.feature_dim),
                chunks=torch.zeros(0, self._base.spec.horizon, ACTION_DIM), radius=self._radius,
            )  # fmt: skip

    def adapt(self, attempt: Attempt, cancelled: Cancelled, progress: Progress) -> Adaptation:
        trial, horizon, began = self._trial, self._base.spec.horizon, time.monotonic()
        outdated: Cancelled = lambda: cancelled() or self._trial is not trial  # noqa: E731
        found = evidence.recorded_values(attempt)
        adaptation = Adaptation(
            status="none", base_version=self.policy.version, version=self.policy.version, values=found,
            value_changes=value_change(found, horizon), threshold=math.nan, flagged=(),
        )  # fmt: skip
        try:
            found = evidence.values(self.network, self.critic, attempt, outdated)
            changes = value_change(found, horizon)
            flags = flag(changes, self.config.attribution)
            adaptation = replace(
                adaptation, values=found, value_changes=changes, threshold=flags.threshold, flagged=flags.ticks
            )
            progress(adaptation)
            features = evidence.features(self.network, attempt, flags.ticks, outdated)
            sent = torch.from_numpy(evidence.sent_chunks(attempt, flags.ticks, horizon))
            self._become(features, sent, outdated)
        except AdaptationCancelledError:
            return replace(adaptation, status="cancelled")
        except FarError as error:
            return replace(adaptation, status="failed", note=str(error))
        return replace(
            adaptation, status="adapted", version=self.policy.version,
            seconds={"attribution": time.monotonic() - began},
            note=f"{len(self.memory.features)} failed chunks are remembered; no weight changed",
        )  # fmt: skip

    def perturb(self, attempt_index: int, scene_seed: int) -> Perturbation:
        return lambda tick: np.zeros(ACTION_DIM)

    def _become(self, features: Float[Tensor, "S F"], chunks: Float[Tensor, "S H A"], outdated: Cancelled) -> None:
        with self._swap:
            check(outdated)
            self._rounds += 1
            self.memory = replace(
                self.memory, features=torch.cat([self.memory.features, features.cpu()]),
                chunks=torch.cat([self.memory.chunks, chunks]),
            )  # fmt: skip
            steering = self._remedy(self.memory, self.critic)
            self.policy = self._act(self.network, f"{BASE_VERSION}+{self.name}{self._rounds}", steering)


@dataclass(frozen=True)
class Named:
    """A method made of a remedy; the three files each name one."""

    name: str
    remedy: Callable[[Ingredients], Remedy]

    def __call__(self, ingredients: Ingredients) -> ResamplingMethod:
        return ResamplingMethod(self.name, ingredients, self.remedy(ingredients))


def radius(ingredients: Ingredients) -> float:
    """How near a state must be to a failed one: a percentile of the distances between the demonstrations' states and
    their nearest others; infinite where no demonstrations lie beside the critic."""
    if ingredients.demonstrations is None:
        return math.inf
    features = ingredients.demonstrations.features
    distances = torch.cdist(features, features).fill_diagonal_(math.inf).min(dim=1).values
    return float(np.percentile(distances.cpu().numpy(), ingredients.config.resampling.radius_percentile))
