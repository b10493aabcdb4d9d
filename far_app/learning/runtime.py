"""The policy that acts: a DiffusionPolicy, its version, and the critic's V(s_t), behind far_app.protocols.Policy.

An engine (far_app/learning/engines) runs the network. Noise comes from outside, so that methods and runs can be
compared; features go to a memory that the critic and the adaptation share.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from far_app.errors import PolicyError
from far_app.learning.critic import Critic
from far_app.learning.engines import Choice, order_of, take
from far_app.learning.memory import Encode, FeatureMemory
from far_app.learning.policy import DiffusionPolicy
from far_app.learning.steering import Steering, more_noise
from far_app.protocols import EngineReport, History, PolicySpec
from far_app.types import ActionChunk


class ActingPolicy:
    """far_app.protocols.Policy for one version of the weights. Not for several threads at once."""

    def __init__(
        self,
        network: DiffusionPolicy,
        version: str,
        critic: Critic | None = None,
        engine: str | Choice = "auto",
        steering: Steering | None = None,
        batch: int | None = None,
        memory: FeatureMemory | None = None,
        base: ActingPolicy | None = None,
    ) -> None:
        """`batch`: plan in batches of exactly so many, the last one filled up. A matrix product rounds differently in
        another shape, and a chunk must not depend on what it happens to be planned beside. `memory`: shared with others
        that look through the same encoder. `base`: the policy this one was adapted from, whose engine goes on."""
        self.batch = batch
        self.network, self.critic, self.version, self.steering = network, critic, version, steering
        self.memory = memory or FeatureMemory()
        self.spec: PolicySpec = network.spec()
        self.device = network.normalizer.low.device
        choice = engine if isinstance(engine, Choice) else order_of(engine, network)
        self._taken = take(
            network, version, choice, each_alone=batch is not None, batch=batch or 1,
            base=base._taken if base is not None else None,
        )  # fmt: skip

    @property
    def runs_on(self) -> EngineReport:
        """far_app.protocols.RunsOnEngine."""
        return self._taken.report

    def another_encoder(self) -> Encode:
        """How the policy sees, for another thread; the version does not matter, for the encoder is frozen."""
        return self._taken.engine.another_encoder()

    def plan(
        self, histories: Sequence[History], ticks: Sequence[int], noise: Float[np.ndarray, "B H A"]
    ) -> list[ActionChunk]:
        if self.batch is None:
            return self._planned(histories, ticks, noise)
        chunks: list[ActionChunk] = []
        for first in range(0, len(histories), self.batch):
            rows = np.minimum(np.arange(first, first + self.batch), len(histories) - 1)
            some = self._planned([histories[i] for i in rows], [ticks[i] for i in rows], noise[rows])
            chunks += some[: len(histories) - first]
        return chunks

    def _planned(
        self, histories: Sequence[History], ticks: Sequence[int], noise: Float[np.ndarray, "B H A"]
    ) -> list[ActionChunk]:
        """In one batch."""
        engine = self._taken.engine
        with torch.no_grad():
            start = torch.from_numpy(np.ascontiguousarray(noise, np.float32)).to(self.device)
            if self.memory.known(histories):
                features = self.memory.of(histories, engine.encode)
                sampled = engine.sample(features, start)
            else:
                features, sampled = engine.plan(histories, start)
                self.memory.keep(histories, features)
            chunks = sampled.cpu().numpy()
            values, shown = np.full(len(ticks), np.nan), features
            if self.critic is not None:
                shown = self.critic.see(histories, features, self.memory)
                values = self.critic.value(shown).cpu().numpy()
            considered: list[np.ndarray | None] = [None] * len(ticks)
            for i in range(len(ticks)):
                if self.steering is not None and self.steering.applies(features[i]):
                    chunks[i], considered[i] = self._steered(self.steering, features[i], shown[i], noise[i])
        if not np.isfinite(chunks).all():
            raise PolicyError(
                f"policy {self.spec.name} ({self.version}) planned a non-finite action at tick {ticks[0]}; check its "
                "training or go back to another checkpoint"
            )
        return [
            ActionChunk(
                tick=tick, actions=chunk, policy_version=engine.version, value=float(value), candidates=candidates
            )
            for tick, chunk, value, candidates in zip(ticks, chunks, values, considered, strict=True)
        ]

    def _steered(
        self, steering: Steering, features: Float[Tensor, "F"], shown: Float[Tensor, "G"], noise: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The chunk that acts instead, and all that were considered."""
        start = torch.from_numpy(more_noise(noise, steering.samples)).to(self.device)
        chunks = self._taken.engine.sample(
            features.expand(len(start), -1), start, push=lambda clean: steering.push(features, clean)
        )
        chosen = chunks[steering.pick(features, shown, chunks)]
        return chosen.cpu().numpy(), chunks.cpu().numpy()
