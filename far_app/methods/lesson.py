"""What one failure teaches: attribution → candidates → pairs → update (paper, Algorithm 1), told as it becomes known.

Everything happens on a private copy of the denoiser; who acts with it, and when, is retry.py's.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import nn

from far_app.config import RetryConfig
from far_app.errors import FarError
from far_app.learning.apart.protocol import Work
from far_app.learning.cancellation import Cancelled, check
from far_app.learning.critic import Critic
from far_app.learning.memory import Encode, FeatureMemory
from far_app.learning.pairs import Pairs, explored, merged, select, weighted_trajectory
from far_app.learning.policy import DiffusionPolicy
from far_app.learning.preference import Demonstrations
from far_app.methods import evidence
from far_app.methods.evidence import sent_chunks
from far_app.protocols import PolicySpec, Progress
from far_app.seeding import generator
from far_app.types import Adaptation, AdaptationStep, Attempt


@dataclass(frozen=True, kw_only=True)
class Learner:
    """Who learns: what acted, what it was made from, and what judges and holds it."""

    spec: PolicySpec
    version: str
    acting: DiffusionPolicy
    """What the failed attempt acted with; candidates are its own."""
    base: DiffusionPolicy
    critic: Critic
    config: RetryConfig
    memory: FeatureMemory
    encode: Encode
    """How the policy sees."""
    demonstrations: Demonstrations | None
    work: Work
    rounds: Sequence[Pairs]
    """Of the trial's earlier lessons, where an update starts from the base with all of them."""


class Lesson:
    """One failure's, with the seconds of each stage."""

    def __init__(self, learner: Learner, attempt: Attempt, cancelled: Cancelled, nothing: Adaptation) -> None:
        """`nothing`: the adaptation as it is before anything was learnt."""
        self.learner, self.attempt, self.cancelled, self.adaptation = learner, attempt, cancelled, nothing
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
        learner = self.learner
        eyes = evidence.Eyes(policy=learner.base, critic=learner.critic, memory=learner.memory, encode=learner.encode)
        self.adaptation = evidence.attributed(
            self.adaptation, self.attempt, eyes, learner.config.attribution, self.cancelled
        )
        self.note("attribution")
        progress(self.adaptation)
        return eyes

    def run(self, progress: Progress) -> tuple[nn.Module | None, Pairs]:
        """The adapted denoiser (None when nothing changed) and the pairs it learnt from."""
        learner, config = self.learner, self.learner.config
        eyes = self.attribute(progress)
        awr = config.fcpa.objective == "awr"
        pairs = self._trajectory(eyes) if awr else self._pairs(eyes, self.adaptation.flagged)
        self.note("pairs", pairs=len(pairs), empty_states=pairs.empty_states)
        progress(self.adaptation)
        if not len(pairs):
            self.note(status="empty", note="no chunk could be paired")
            return None, pairs

        check(self.cancelled)
        accumulate = config.fcpa.accumulate
        denoiser = copy.deepcopy((learner.acting if accumulate else learner.base).denoiser).requires_grad_(True).eval()
        update = learner.work.update(
            denoiser, pairs if accumulate else merged([*learner.rounds, pairs]), config.fcpa,
            (self.attempt.scene_seed, self.attempt.index), self.cancelled,
            lambda step: (self.history.append(step), progress(step))[1], learner.demonstrations,
        )  # fmt: skip
        denoiser.requires_grad_(False)
        self.note("update", status=update.status, history=update.history, note=update.note)
        return (denoiser if update.changed else None), pairs

    def _pairs(self, eyes: evidence.Eyes, ticks: tuple[int, ...]) -> Pairs:
        """Candidates under the policy that acted, filtered and ranked, for every flagged chunk."""
        learner, config, critic = self.learner, self.learner.config.pairs, eyes.critic
        spec = learner.spec
        seen = eyes.own(self.attempt, ticks, self.cancelled)
        shown = eyes.critics(self.attempt, ticks, self.cancelled)
        negatives = torch.from_numpy(sent_chunks(self.attempt, ticks, spec.horizon)).to(seen.device)
        shape = (config.candidates, spec.horizon, spec.action_dim)
        noise = [self._rng("candidates", t).standard_normal(shape, dtype=np.float32) for t in ticks]
        self.note("encoding")

        with torch.no_grad():
            stacked = torch.from_numpy(np.stack(noise)) if noise else torch.zeros(0, *shape)
            chunks = learner.work.candidates(
                learner.acting.denoiser, learner.base.config.ddim_steps, seen, stacked.to(seen.device), self.cancelled
            )
            if not bool(torch.isfinite(chunks).all()):
                raise FarError(f"the policy {learner.version} sampled a non-finite candidate; nothing was learnt")
            if config.explore > 0:
                chunks = explored(chunks, config.explore, self._rng("exploration"))
            self.note("candidates")
            check(self.cancelled)
            pairs = select(chunks, seen, negatives, critic.q, config, shown)
            self.note(contrasts=evidence.contrasts(pairs, ticks, shown, critic, config.arm_only))
            return pairs

    def _trajectory(self, eyes: evidence.Eyes) -> Pairs:
        """Every whole chunk of the attempt, weighted by its advantage (the awr objective)."""
        horizon = self.learner.spec.horizon
        ticks = range(len(self.attempt.steps) - horizon + 1)
        seen = eyes.own(self.attempt, ticks, self.cancelled)
        shown = eyes.critics(self.attempt, ticks, self.cancelled)
        chunks = torch.from_numpy(sent_chunks(self.attempt, ticks, horizon)).to(seen.device)
        with torch.no_grad():
            advantages = eyes.critic.q(shown, chunks) - eyes.critic.value(shown)
            return weighted_trajectory(seen, chunks, advantages)

    def _rng(self, purpose: str, *key: int) -> np.random.Generator:
        return generator(purpose, self.attempt.scene_seed, self.attempt.index, *key)
