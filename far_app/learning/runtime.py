"""The policy that acts: a DiffusionPolicy, its version, and the critic's V(s_t), behind far_app.protocols.Policy.

An observation's camera features are computed once, where the encoder shares its weights over the frames: the next tick
finds the previous frame's already there. Noise comes from outside, so that methods and runs can be compared.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from far_app.errors import PolicyError
from far_app.learning.critic import Critic
from far_app.learning.diffusion import ddim_sample
from far_app.learning.engines import Engine, runner
from far_app.learning.policy import DiffusionPolicy
from far_app.learning.steering import Steering, more_noise
from far_app.protocols import History, PolicySpec
from far_app.types import ActionChunk, Observation

KEPT_FRAMES = 64
"""Observations whose camera features are kept: a history each for a few dozen robots."""


class ActingPolicy:
    """far_app.protocols.Policy for one version of the weights. Not for several threads at once."""

    def __init__(
        self,
        network: DiffusionPolicy,
        version: str,
        critic: Critic | None = None,
        engine: Engine = "auto",
        steering: Steering | None = None,
        batch: int | None = None,
    ) -> None:
        """`batch`: plan in batches of exactly so many, the last one filled up. A matrix product rounds differently in
        another shape, and a chunk must not depend on what it happens to be planned beside."""
        self.batch = batch
        self.network, self.critic, self.version, self.steering = network, critic, version, steering
        self.spec: PolicySpec = network.spec()
        self.device = network.normalizer.low.device
        self._denoiser = runner(network.denoiser, network.config.horizon, engine)
        self._kept: OrderedDict[int, tuple[Observation, list[Tensor]]] = OrderedDict()

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
        with torch.inference_mode():
            features = self.features(histories)
            condition = self._denoiser.condition(features)
            start = torch.from_numpy(np.ascontiguousarray(noise, np.float32)).to(self.device)
            chunks = ddim_sample(self._denoiser.run, condition, start, self.network.config.ddim_steps).cpu().numpy()
            values, shown = np.full(len(ticks), np.nan), features
            if self.critic is not None:
                shown = self.critic.see(histories, features)
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
                tick=tick, actions=chunk, policy_version=self.version, value=float(value), candidates=candidates
            )
            for tick, chunk, value, candidates in zip(ticks, chunks, values, considered, strict=True)
        ]

    def _steered(
        self, steering: Steering, features: Float[Tensor, "F"], shown: Float[Tensor, "G"], noise: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The chunk that acts instead, and all that were considered."""
        start = torch.from_numpy(more_noise(noise, steering.samples)).to(self.device)
        condition = self._denoiser.condition(features[None]).expand(len(start), -1)
        chunks = ddim_sample(
            self._denoiser.run, condition, start, self.network.config.ddim_steps,
            push=lambda clean: steering.push(features, clean),
        )  # fmt: skip
        chosen = chunks[steering.pick(features, shown, chunks)]
        return chosen.cpu().numpy(), chunks.cpu().numpy()

    def features(self, histories: Sequence[History]) -> Float[Tensor, "B F"]:
        """Features of each history, every shared frame encoded once."""
        network = self.network
        if network.encoder.per_frame:
            return network.encode(histories)
        self._encode_new([o for h in histories for o in h])
        frames = [
            [torch.cat([self._kept[id(h[t])][1][c] for h in histories]) for c in range(len(network.config.cameras))]
            for t in range(network.config.n_obs)
        ]
        return network.encoder.join(frames, network.normalizer(network.states(histories)))

    def _encode_new(self, observations: Sequence[Observation]) -> None:
        unseen = list({id(o): o for o in observations if id(o) not in self._kept}.values())
        size = max(1, len(unseen)) if self.batch is None else 1
        for new in (unseen[i : i + size] for i in range(0, len(unseen), size)):
            per_camera = [
                self.network.encoder.camera_features(
                    c, 0, torch.from_numpy(np.stack([o.images[c] for o in new])).to(self.device)
                )
                for c in self.network.config.cameras
            ]
            for i, observation in enumerate(new):
                self._kept[id(observation)] = (observation, [f[i : i + 1] for f in per_camera])
        while len(self._kept) > max(KEPT_FRAMES, 2 * len(observations)):
            self._kept.popitem(last=False)
