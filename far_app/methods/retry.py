"""The one implementation behind nr, perturb, fcpa and far: learn from a failure, perturb the retry, or neither.

A failure is learnt from in four steps (paper, Algorithm 1), on a private copy of the denoiser; only when all are done
does the acting policy change, at once, to a new version. The base network is never written to, so the base policy's
return at a trial's end is exact.
"""

from __future__ import annotations

import copy
import threading
import time
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor, nn

from far_app.config import RetryConfig
from far_app.errors import ConfigError, FarError
from far_app.learning import diffusion, fcpa
from far_app.learning.adapted import denoiser_of
from far_app.learning.cancellation import AdaptationCancelledError, Cancelled, abandonable, check
from far_app.learning.critic import Critic
from far_app.learning.memory import FeatureMemory
from far_app.learning.pairs import Pairs, candidates, explored, merged, select, weighted_trajectory
from far_app.learning.policy import DiffusionPolicy, fingerprint
from far_app.learning.preference import Demonstrations, Noising
from far_app.learning.steering import Steering
from far_app.learning.trainable import Arrange, trainable
from far_app.methods import evidence
from far_app.methods.evidence import sent_chunks
from far_app.perturbation import Perturbation, perturbation
from far_app.protocols import Policy, Progress
from far_app.seeding import generator
from far_app.types import Adaptation, AdaptationStep, AdaptedWeights, Attempt


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
    arrange: Arrange = trainable
    """How the denoiser is run for candidates and the update; `plain` to compare with."""


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
        self.arrange = ingredients.arrange
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
        learning = _Learning(self, attempt, outdated, nothing)
        try:
            if self.config.fcpa.hedge and version != self._base_policy.version:
                learning.attribute(progress)
                self._withdraw(outdated)
                learning.note(
                    status="withdrawn", version=self._base_policy.version, note="the lesson failed: a plain try next"
                )
                return learning.adaptation
            denoiser, pairs = learning.run(progress)
            if denoiser is not None:
                self._become(denoiser, pairs, outdated)
                learning.note("engine", version=self.policy.version)
        except AdaptationCancelledError:
            learning.note(status="cancelled")
        except FarError as error:
            learning.note(status="failed", note=str(error))
        return learning.adaptation

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


class _Learning:
    """One failure's lesson: attribution → candidates → pairs → update, each timed."""

    def __init__(self, method: RetryMethod, attempt: Attempt, cancelled: Cancelled, nothing: Adaptation) -> None:
        self.method, self.attempt, self.cancelled, self.adaptation = method, attempt, cancelled, nothing
        self.history: list[AdaptationStep] = []
        self._last = time.monotonic()

    def note(self, stage: str = "", **changes: object) -> None:
        """Write down what is known so far, and the seconds since the last stage ended."""
        seconds = dict(self.adaptation.seconds)
        if stage:
            now = time.monotonic()
            seconds[stage] = now - self._last
            self._last = now
        self.adaptation = replace(self.adaptation, seconds=seconds, **changes)

    def attribute(self, progress: Progress) -> evidence.Eyes:
        """Find the chunks to blame; returns the eyes that did."""
        method = self.method
        assert method.critic is not None, "checked when the method was made"
        eyes = evidence.Eyes(policy=method.base, critic=method.critic, memory=method.memory)
        self.adaptation = evidence.attributed(
            self.adaptation, self.attempt, eyes, method.config.attribution, self.cancelled
        )
        self.note("attribution")
        progress(self.adaptation)
        return eyes

    def run(self, progress: Progress) -> tuple[nn.Module | None, Pairs]:
        """The adapted denoiser (None when nothing changed) and the pairs it learnt from."""
        method, config = self.method, self.method.config
        eyes = self.attribute(progress)
        awr = config.fcpa.objective == "awr"
        pairs = self._trajectory(eyes) if awr else self._pairs(eyes, self.adaptation.flagged)
        self.note("pairs", pairs=len(pairs), empty_states=pairs.empty_states)
        progress(self.adaptation)
        if not len(pairs):
            self.note(status="empty", note="no chunk could be paired")
            return None, pairs

        accumulate = config.fcpa.accumulate
        denoiser = copy.deepcopy((method.acting if accumulate else method.base).denoiser).requires_grad_(True).eval()
        update = fcpa.adapt(
            denoiser, Noising(add_noise=diffusion.add_noise, steps=diffusion.TRAIN_STEPS),
            pairs if accumulate else merged([*method.rounds, pairs]), config.fcpa, self._rng("fcpa"), self.cancelled,
            lambda step: (self.history.append(step), progress(step))[1], method.demonstrations,
            method.arrange,
        )  # fmt: skip
        denoiser.requires_grad_(False)
        self.note("update", status=update.status, history=update.history, note=update.note)
        return (denoiser if update.changed else None), pairs

    def _pairs(self, eyes: evidence.Eyes, ticks: tuple[int, ...]) -> Pairs:
        """Candidates under the policy that acted, filtered and ranked, for every flagged chunk."""
        method, config, critic = self.method, self.method.config.pairs, eyes.critic
        spec = method.policy.spec
        seen = eyes.own(self.attempt, ticks, self.cancelled)
        shown = eyes.critics(self.attempt, ticks, self.cancelled)
        negatives = torch.from_numpy(sent_chunks(self.attempt, ticks, spec.horizon)).to(seen.device)
        shape = (config.candidates, spec.horizon, spec.action_dim)
        noise = [self._rng("candidates", t).standard_normal(shape, dtype=np.float32) for t in ticks]
        self.note("encoding")

        runner = method.arrange(method.acting.denoiser, spec.horizon, train=False)

        def denoiser(noisy: Tensor, k: Tensor, condition: Tensor) -> Tensor:
            check(self.cancelled)
            return runner.run(noisy, k, condition)

        def sample(condition: Tensor, start: Tensor) -> Tensor:
            return diffusion.ddim_sample(denoiser, condition, start, method.base.config.ddim_steps)

        with torch.no_grad():
            stacked = torch.from_numpy(np.stack(noise)) if noise else torch.zeros(0, *shape)
            chunks = candidates(sample, runner.condition(seen), stacked.to(seen.device), self.cancelled)
            if not bool(torch.isfinite(chunks).all()):
                raise FarError(f"the policy {method.policy.version} sampled a non-finite candidate; nothing was learnt")
            if config.explore > 0:
                chunks = explored(chunks, config.explore, self._rng("exploration"))
            self.note("candidates")
            pairs = select(chunks, seen, negatives, critic.q, config, shown)
            self.note(contrasts=evidence.contrasts(pairs, ticks, shown, critic, config.arm_only))
            return pairs

    def _trajectory(self, eyes: evidence.Eyes) -> Pairs:
        """Every whole chunk of the attempt, weighted by its advantage (the awr objective)."""
        horizon = self.method.policy.spec.horizon
        ticks = range(len(self.attempt.steps) - horizon + 1)
        seen = eyes.own(self.attempt, ticks, self.cancelled)
        shown = eyes.critics(self.attempt, ticks, self.cancelled)
        chunks = torch.from_numpy(sent_chunks(self.attempt, ticks, horizon)).to(seen.device)
        with torch.no_grad():
            advantages = eyes.critic.q(shown, chunks) - eyes.critic.value(shown)
            return weighted_trajectory(seen, chunks, advantages)

    def _rng(self, purpose: str, *key: int) -> np.random.Generator:
        return generator(purpose, self.attempt.scene_seed, self.attempt.index, *key)
