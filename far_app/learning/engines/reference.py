"""The reference: encoder, U-Net and DDIM loop in eager torch, as they are written. Every other engine is held to it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from far_app.learning.diffusion import ddim_sample
from far_app.learning.engines.protocol import Entry, Push
from far_app.learning.memory import Encode
from far_app.learning.policy import DiffusionPolicy
from far_app.protocols import History


class ReferenceEngine:
    """far_app.learning.engines.Engine."""

    name = "torch"

    def __init__(self, network: DiffusionPolicy, version: str, each_alone: bool = False) -> None:
        self.network, self.version, self.each_alone = network, version, each_alone

    def encode(self, histories: Sequence[History]) -> Float[Tensor, "B F"]:
        if self.each_alone:
            return torch.cat([self.network.encode([h]) for h in histories])
        return self.network.encode(histories)

    def another_encoder(self) -> Encode:
        return self.encode

    @torch.no_grad()
    def sample(
        self, features: Float[Tensor, "B F"], noise: Float[Tensor, "B H A"], push: Push | None = None
    ) -> Float[Tensor, "B H A"]:
        return ddim_sample(self.network.denoiser, features, noise, self.network.config.ddim_steps, push)

    def plan(self, histories: Sequence[History], noise: Float[Tensor, "B H A"]) -> tuple[Tensor, Tensor]:
        features = self.encode(histories)
        return features, self.sample(features, noise)

    def adapted(self, network: DiffusionPolicy, version: str) -> ReferenceEngine:
        return ReferenceEngine(network, version, self.each_alone)


ENTRY = Entry(
    name="torch", summary="the reference: eager torch", make=ReferenceEngine, unusable=lambda network: "", tolerance=0.0
)
