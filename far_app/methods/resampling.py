"""Retries that act otherwise without learning: the shared part of bgr, rerank and negative-guidance.

A failure is attributed as FAR attributes it; the flagged states with their sent chunks go into the trial's memory, from
which a Steering for the acting policy is made. The weights never change, and the first attempt is the base policy's.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from far_app.errors import ConfigError, FarError
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

    def __init__(self, name: str, ingredients: Ingredients, remedy: Callable[[Ingredients], Remedy]) -> None:
        if ingredients.critic is None:
            raise ConfigError(f"method '{name}' needs a critic; train one with `far train critic`, or use nr")
        self.name = name
        self.network, self.critic, self.config = ingredients.network, ingredients.critic, ingredients.config
        self._act, self._remedy = ingredients.act, remedy(ingredients)
        self._eyes = evidence.Eyes(
            policy=self.network, critic=self.critic, memory=ingredients.memory, encode=ingredients.seeing()
        )
        self._swap = threading.Lock()
        self._base = self._act(self.network, BASE_VERSION)
        self.begin(0)

    def begin(self, scene_seed: int) -> None:
        with self._swap:
            self.policy, self._rounds = self._base, 0
            self._trial = object()
            self.memory = Memory.empty(self.network.feature_dim, self._base.spec.horizon)

    def adapt(self, attempt: Attempt, cancelled: Cancelled, progress: Progress) -> Adaptation:
        trial, began = self._trial, time.monotonic()
        outdated: Cancelled = lambda: cancelled() or self._trial is not trial  # noqa: E731
        adaptation = evidence.unlearnt(attempt, self.policy.version, self._base.spec.horizon)
        try:
            adaptation = evidence.attributed(adaptation, attempt, self._eyes, self.config.attribution, outdated)
            progress(adaptation)
            self._remember(attempt, adaptation.flagged, outdated)
        except AdaptationCancelledError:
            return replace(adaptation, status="cancelled")
        except FarError as error:
            return replace(adaptation, status="failed", note=str(error))
        return replace(
            adaptation, status="adapted", version=self.policy.version,
            seconds={"attribution": time.monotonic() - began},
            note=f"{len(self.memory)} failed chunks are remembered; no weight changed",
        )  # fmt: skip

    def perturb(self, attempt_index: int, scene_seed: int) -> Perturbation:
        return lambda tick: np.zeros(ACTION_DIM)

    def _remember(self, attempt: Attempt, ticks: Sequence[int], outdated: Cancelled) -> None:
        """Add the flagged chunks to the memory and act by it, unless a new trial began or nobody waits any more."""
        features = self._eyes.own(attempt, ticks, outdated)
        sent = torch.from_numpy(evidence.sent_chunks(attempt, ticks, self._base.spec.horizon))
        with self._swap:
            check(outdated)
            self._rounds += 1
            self.memory = self.memory.grown(features, sent.to(features.device))
            steering = self._remedy(self.memory, self.critic)
            self.policy = self._act(self.network, f"{BASE_VERSION}+{self.name}{self._rounds}", steering)


def radius(name: str, ingredients: Ingredients) -> float:
    """How near a state must be to a failed one: a percentile of the distances between the demonstrations' states and
    their nearest others. ConfigError where no demonstrations lie beside the critic."""
    if ingredients.demonstrations is None:
        raise ConfigError(
            f"method '{name}' measures distances by the demonstrations beside the critic, and there are none; train "
            "the critic with `far train critic`, or use nr or rerank"
        )
    features = ingredients.demonstrations.features
    distances = torch.cdist(features, features).fill_diagonal_(math.inf).min(dim=1).values
    return float(np.percentile(distances.cpu().numpy(), ingredients.config.resampling.radius_percentile))
