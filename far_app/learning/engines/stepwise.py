"""An engine made of two parts: camera features frame by frame, and the chain of denoising steps.

An observation's camera features are computed once where the encoder shares its weights over the frames: the next tick
finds the previous frame's already there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from far_app.learning.engines.protocol import Push
from far_app.learning.memory import Encode, FeatureMemory
from far_app.learning.policy import DiffusionPolicy
from far_app.protocols import History
from far_app.types import Observation

KEPT_FRAMES = 64
"""Observations whose camera features are kept: a history each for a few dozen robots."""

Look = tuple[str, int, UInt8[Tensor, "B S S 3"]]
"""A camera, a place in the history (0 oldest), and the pictures there."""
CameraFeatures = Callable[[Sequence[Look]], Sequence[Float[Tensor, "B D"]]]
"""Of each look; no two of them are of the same camera and place."""


def one_by_one(features: Callable[[str, int, UInt8[Tensor, "B S S 3"]], Float[Tensor, "B D"]]) -> CameraFeatures:
    """From a function for a single look."""
    return lambda looks: [features(*look) for look in looks]


class Chain(Protocol):
    """The DDIM chain under fixed weights."""

    def condition(self, features: Float[Tensor, "S F"]) -> Tensor:
        """The observation's part, once a state."""
        ...

    def sample(self, noise: Float[Tensor, "B H A"], condition: Tensor, push: Push | None) -> Float[Tensor, "B H A"]:
        """Chunks in [−1, 1], one row of `condition` each."""
        ...


class Frames:
    """Features of histories from a function for pictures."""

    def __init__(
        self, network: DiffusionPolicy, camera_features: CameraFeatures, each_alone: bool,
        another: Callable[[], CameraFeatures] | None = None,
    ) -> None:  # fmt: skip
        """`another`: the same function for another thread; itself where it is for any number of them."""
        self.network, self.camera_features, self.each_alone = network, camera_features, each_alone
        self._another = another or (lambda: camera_features)
        self._kept = FeatureMemory(KEPT_FRAMES)

    def features(self, histories: Sequence[History]) -> Float[Tensor, "B F"]:
        network = self.network
        places = range(network.config.n_obs)
        state = network.normalizer(network.states(histories))
        if not network.config.cameras:
            return network.encoder.join([[] for _ in places], state)
        if network.encoder.per_frame:
            seen = self._cameras([[h[t] for h in histories] for t in places])
        else:
            frames = [h[t] for t in places for h in histories]
            self._kept.room_for(2 * len(frames))
            known = self._kept.of([(o,) for o in frames], lambda new: self._cameras([[o for (o,) in new]])[0])
            seen = known.split(len(histories))
        each = [list(s.split(network.encoder.frame_dim, dim=1)) for s in seen]
        return network.encoder.join(each, state)

    def another(self) -> Frames:
        """The same for another thread."""
        return Frames(self.network, self._another(), self.each_alone)

    def _cameras(self, observations: Sequence[Sequence[Observation]]) -> list[Float[Tensor, "B C*D"]]:
        """All cameras' features, side by side, of the observations at each place in the history."""
        count, cameras = len(observations[0]), self.network.config.cameras
        size = 1 if self.each_alone else count
        device = self.network.normalizer.low.device
        rows = []
        for first in range(0, count, size):
            found = self.camera_features([
                (c, place, torch.from_numpy(np.stack([o.images[c] for o in there[first : first + size]])).to(device))
                for place, there in enumerate(observations) for c in cameras
            ])  # fmt: skip
            rows.append([torch.cat([*found[i : i + len(cameras)]], dim=1) for i in range(0, len(found), len(cameras))])
        return [torch.cat(there) for there in zip(*rows, strict=True)]


class StepwiseEngine:
    """far_app.learning.engines.Engine."""

    def __init__(
        self, name: str, network: DiffusionPolicy, version: str, frames: Frames,
        chain: Callable[[DiffusionPolicy], Chain],
    ) -> None:  # fmt: skip
        """`chain` makes the fast form of a network's present weights."""
        self.name, self.network, self.version, self.frames = name, network, version, frames
        self._make_chain = chain
        self.chain = chain(network)

    @torch.no_grad()
    def encode(self, histories: Sequence[History]) -> Float[Tensor, "B F"]:
        return self.frames.features(histories)

    def another_encoder(self) -> Encode:
        return torch.no_grad()(self.frames.another().features)

    @torch.no_grad()
    def sample(
        self, features: Float[Tensor, "B F"], noise: Float[Tensor, "B H A"], push: Push | None = None
    ) -> Float[Tensor, "B H A"]:
        return self.chain.sample(noise, self.chain.condition(features), push)

    def plan(self, histories: Sequence[History], noise: Float[Tensor, "B H A"]) -> tuple[Tensor, Tensor]:
        features = self.encode(histories)
        return features, self.sample(features, noise)

    def adapted(self, network: DiffusionPolicy, version: str) -> StepwiseEngine:
        return StepwiseEngine(self.name, network, version, self.frames, self._make_chain)
