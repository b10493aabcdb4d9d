"""An engine made of two parts: camera features frame by frame, and the chain of denoising steps.

An observation's camera features are computed once where the encoder shares its weights over the frames: the next tick
finds the previous frame's already there. Where every place in the history has a network of its own, a picture is looked
at again as the next tick's previous frame: begun while the chain runs, so that the next tick need not wait for it.
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
Begin = Callable[[Sequence[Look]], Callable[[], Sequence[Float[Tensor, "B D"]]]]
"""The same in the background: what it gives waits for the features."""


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
        another: Callable[[], CameraFeatures] | None = None, begin: Begin | None = None,
    ) -> None:  # fmt: skip
        """`another`: the same function for another thread; itself where it is for any number of them. `begin`: look
        ahead with it."""
        self.network, self.camera_features, self.each_alone = network, camera_features, each_alone
        self._another = another or (lambda: camera_features)
        self._kept = FeatureMemory(KEPT_FRAMES)
        self._begin = begin if network.encoder.per_frame else None
        self._begun: tuple[list[tuple[int, Observation]], Callable[[], Sequence[Float[Tensor, "1 D"]]]] | None = None
        self._newest: Observation | None = None

    def features(self, histories: Sequence[History]) -> Float[Tensor, "B F"]:
        network = self.network
        places = range(network.config.n_obs)
        state = network.normalizer(network.states(histories))
        if not network.config.cameras:
            return network.encoder.join([[] for _ in places], state)
        if network.encoder.per_frame:
            self._finish()
            seen = [self._at_place([h[t] for h in histories], t) for t in places]
            self._look_ahead(histories)
        else:
            frames = [h[t] for t in places for h in histories]
            self._kept.room_for(2 * len(frames))
            known = self._kept.of([(o,) for o in frames], lambda new: self._cameras([o for (o,) in new], 0))
            seen = known.split(len(histories))
        each = [list(s.split(network.encoder.frame_dim, dim=1)) for s in seen]
        return network.encoder.join(each, state)

    def another(self) -> Frames:
        """The same for another thread."""
        return Frames(self.network, self._another(), self.each_alone)

    def _at_place(self, observations: Sequence[Observation], place: int) -> Float[Tensor, "B C*D"]:
        """All cameras' features by the networks of a place in the history."""
        self._kept.room_for(2 * self.network.config.n_obs * len(observations))
        return self._kept.of(
            [(o,) for o in observations], lambda new: self._cameras([o for (o,) in new], place), eyes=str(place)
        )

    def _look_ahead(self, histories: Sequence[History]) -> None:
        """Begin on this history's frames as the next tick's older ones. Not where plans are further apart than a tick
        or made for several robots at once: no history, or no idle core, would wait for it."""
        (*older, newest), before = histories[0], self._newest
        self._newest = newest
        if self._begin is None or len(histories) > 1 or not older or older[-1] is not before:
            return
        frames = list(enumerate(histories[0][1:]))
        self._begun = frames, self._begin([look for place, frame in frames for look in self._looks([frame], place)])

    def _finish(self) -> None:
        """Keep what was begun; its networks are free again then."""
        if self._begun is None:
            return
        (frames, wait), self._begun = self._begun, None
        found, cameras = wait(), len(self.network.config.cameras)
        for i, (place, frame) in enumerate(frames):
            row = torch.cat([*found[i * cameras : (i + 1) * cameras]], dim=1)
            self._kept.keep([(frame,)], row, eyes=str(place))

    def _cameras(self, observations: Sequence[Observation], place: int) -> Float[Tensor, "B C*D"]:
        """All cameras' features, side by side."""
        size = 1 if self.each_alone else len(observations)
        return torch.cat([
            torch.cat([*self.camera_features(self._looks(observations[first : first + size], place))], dim=1)
            for first in range(0, len(observations), size)
        ])  # fmt: skip

    def _looks(self, observations: Sequence[Observation], place: int) -> list[Look]:
        device = self.network.normalizer.low.device
        return [
            (c, place, torch.from_numpy(np.stack([o.images[c] for o in observations])).to(device))
            for c in self.network.config.cameras
        ]


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
