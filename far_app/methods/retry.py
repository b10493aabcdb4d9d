"""The one implementation behind nr, perturb, fcpa and far: learn from a failure, perturb the retry, or neither.

A lesson (lesson.py) is learnt on a private copy of the denoiser; only when it is done does the acting policy change, at
once, to a new version. The base network is never written to, so the base policy's return at a trial's end is exact.
"""

from __future__ import annotations

import copy
import functools
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

from torch import nn

from far_app.config import RetryConfig
from far_app.errors import ConfigError, FarError
from far_app.learning import fcpa
from far_app.learning.adapted import denoiser_of
from far_app.learning.apart.here import WorkHere
from far_app.learning.apart.protocol import Work
from far_app.learning.cancellation import AdaptationCancelledError, Cancelled, abandonable, check
from far_app.learning.critic import Critic
from far_app.learning.memory import Encode, FeatureMemory
from far_app.learning.pairs import Pairs
from far_app.learning.policy import DiffusionPolicy, fingerprint
from far_app.learning.preference import Demonstrations
from far_app.learning.steering import Steering
from far_app.methods import evidence
from far_app.methods.lesson import Learner, Lesson
from far_app.perturbation import Perturbation, perturbation
from far_app.protocols import Policy, Progress
from far_app.types import Adaptation, AdaptedWeights, Attempt


class Act(Protocol):
    """Makes the Policy that acts with this network, under this version, steered or not."""

    def __call__(self, network: DiffusionPolicy, version: str, steering: Steering | None = None) -> Policy: ...


BASE_VERSION = "base"


@dataclass(frozen=True, kw_only=True)
class Ingredients:
    """What any method is made from."""

    network: DiffusionPolicy
    """The base policy; never written to."""
    critic: Critic | None
    act: Act
    config: RetryConfig = field(default_factory=RetryConfig)
    demonstrations: Demonstrations | None = None
    """The bc guard and the failure memory's radius need them."""
    memory: FeatureMemory = field(default_factory=FeatureMemory)
    """What the acting policies have seen; shared with them, so that nothing is encoded twice."""
    encoder: Callable[[], Encode] | None = None
    """Makes what learning sees with where nobody saw before: the policy's encoder in a faster form, for one thread."""
    work: Callable[[], Work] = WorkHere
    """Who makes candidates and updates; what is learnt does not depend on it. Asked for by a method that learns."""

    def seeing(self) -> Encode:
        """How a lesson sees; for one thread."""
        return self.encoder() if self.encoder is not None else self.network.encode


class RetryMethod:
    """far_app.protocols.Method."""

    def __init__(self, name: str, ingredients: Ingredients, adapts: bool, perturbs: bool) -> None:
        self.name = name
        self.adapts = adapts
        self._first = ingredients.network
        """What it was made with; its encoder and normaliser are every version's."""
        self.base = self._first
        """With which trials begin."""
        self.critic = ingredients.critic
        self.memory = ingredients.memory
        self._seeing = ingredients.seeing
        self.work = ingredients.work() if adapts else WorkHere()
        self.config = ingredients.config
        self.demonstrations = ingredients.demonstrations
        self.perturbation = self.config.perturbation
        if not perturbs:
            self.perturbation = replace(self.perturbation, kind="none")
        if adapts:
            fcpa.check_config(self.config.fcpa, self.demonstrations)
            if self.critic is None:
                raise ConfigError(f"method '{name}' needs a critic; train one with `far train critic`, or use nr")
        self.adapted: AdaptedWeights | None = None
        """far_app.protocols.KeepsWeights."""
        self._fingerprint = ""
        self._act = ingredients.act
        self._swap = threading.Lock()
        self._first_policy = self._base_policy = self._act(self.base, BASE_VERSION)
        self._base_weights: AdaptedWeights | None = None
        self._lessons: list[tuple[AdaptedWeights, list[Pairs]]] = []
        """What each version of this trial was learnt from."""
        self._scene = 0
        self._trial = 0
        self._restore()

    @functools.cached_property
    def encode(self) -> Encode:
        """How a lesson sees, made with the first one."""
        return self._seeing()

    def begin(self, scene_seed: int) -> None:
        with self._swap:
            self._scene = scene_seed
            self._restore()

    def adapt(self, attempt: Attempt, cancelled: Cancelled, progress: Progress) -> Adaptation:
        trial, version = self._trial, self.policy.version
        outdated: Cancelled = lambda: cancelled() or self._trial != trial  # noqa: E731
        nothing = evidence.unlearnt(attempt, version, self.policy.spec.horizon)
        if not self.adapts:
            return nothing
        lesson = Lesson(self._learner(), attempt, outdated, nothing)
        try:
            if self.config.fcpa.hedge and version != self._base_policy.version:
                lesson.attribute(progress)
                self._withdraw(outdated)
                lesson.note(
                    status="withdrawn", version=self._base_policy.version, note="the lesson failed: a plain try next"
                )
                return lesson.adaptation
            denoiser, pairs = lesson.run(progress)
            if denoiser is not None:
                self._become(denoiser, pairs, outdated)
                lesson.note("engine", version=self.policy.version)
        except AdaptationCancelledError:
            lesson.note(status="cancelled")
        except FarError as error:
            lesson.note(status="failed", note=str(error))
        return lesson.adaptation

    def use(self, weights: AdaptedWeights | None, version: str, *, base: bool) -> None:
        """far_app.protocols.ChangesWeights."""
        network, policy = self._first, self._first_policy
        if weights is not None:
            self._fingerprint = self._fingerprint or fingerprint(self._first)
            network = with_denoiser(self._first, denoiser_of(weights, self._first, self._fingerprint))
            policy = self._act(network, version)
        with self._swap:
            self.acting, self.policy, self.adapted = network, policy, weights
            self.rounds = next((list(pairs) for known, pairs in self._lessons if known is weights), [])
            if base:
                self.base, self._base_policy, self._base_weights = network, policy, weights

    def perturb(self, attempt_index: int, scene_seed: int) -> Perturbation:
        return perturbation(self.perturbation, scene_seed, attempt_index)

    def _learner(self) -> Learner:
        assert self.critic is not None, "checked when the method was made"
        return Learner(
            spec=self.policy.spec, version=self.policy.version, acting=self.acting, base=self.base,
            critic=self.critic, config=self.config, memory=self.memory, encode=self.encode,
            demonstrations=self.demonstrations, work=self.work, rounds=self.rounds,
        )  # fmt: skip

    def _restore(self) -> None:
        self._trial += 1
        self.acting = self.base
        self.policy = self._base_policy
        self.adapted = self._base_weights
        self.rounds: list[Pairs] = []
        self._lessons.clear()
        self._adaptations = 0

    def _withdraw(self, outdated: Cancelled) -> None:
        """The base policy acts again; what was learnt stays known for the next lesson."""
        with self._swap:
            check(outdated)
            self.acting, self.policy = self.base, self._base_policy

    def _become(self, denoiser: nn.Module, pairs: Pairs, outdated: Cancelled) -> None:
        """Swap the acting policy, unless a new trial began or nobody waits any more."""
        network = with_denoiser(self.base, denoiser)
        version = f"{BASE_VERSION}+a{self._adaptations + 1}"
        policy = abandonable(lambda: self._act(network, version), outdated)
        self._fingerprint = self._fingerprint or fingerprint(self._first)
        parent = self.policy if self.config.fcpa.accumulate else self._base_policy
        weights = AdaptedWeights(
            version=policy.version, parent=parent.version, base=self._fingerprint,
            tensors={name: tensor.cpu().numpy() for name, tensor in denoiser.state_dict().items()},
        )  # fmt: skip
        with self._swap:
            check(outdated)
            self._adaptations += 1
            self.rounds = [*self.rounds, pairs]
            self._lessons.append((weights, self.rounds))
            self.acting, self.policy, self.adapted = network, policy, weights


def with_denoiser(network: DiffusionPolicy, denoiser: nn.Module) -> DiffusionPolicy:
    """The same policy with other denoiser weights; encoder and normaliser are shared, not copied."""
    other = copy.copy(network)
    other._modules = {**network._modules, "denoiser": denoiser}
    return other
