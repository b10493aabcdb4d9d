"""Torch without the reference's waste: the U-Net as a few matrix products (fast_unet), frames encoded once. CPU."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from far_app.learning.diffusion import ddim_sample
from far_app.learning.engines.protocol import Entry, Push
from far_app.learning.engines.stepwise import Frames, StepwiseEngine, one_by_one
from far_app.learning.fast_unet import FastUnet, arrangeable
from far_app.learning.policy import DiffusionPolicy


class ArrangedChain:
    """far_app.learning.engines.stepwise.Chain of a FastUnet's present weights."""

    def __init__(self, fast: FastUnet, steps: int) -> None:
        self.fast, self.steps = fast, steps

    def condition(self, features: Float[Tensor, "S F"]) -> Float[Tensor, "S M"]:
        return self.fast.condition(features)

    def sample(
        self, noise: Float[Tensor, "B H A"], condition: Float[Tensor, "B M"], push: Push | None = None
    ) -> Float[Tensor, "B H A"]:
        return ddim_sample(self.fast.run, condition, noise, self.steps, push)


def make(network: DiffusionPolicy, version: str, each_alone: bool) -> StepwiseEngine:
    frames = Frames(network, one_by_one(network.encoder.camera_features), each_alone)
    return StepwiseEngine("arranged", network, version, frames, chain)


def chain(network: DiffusionPolicy) -> ArrangedChain:
    return ArrangedChain(FastUnet(network.denoiser, network.config.horizon), network.config.ddim_steps)


def unusable(network: DiffusionPolicy) -> str:
    if arrangeable(network.denoiser, network.config.horizon) is not None:
        return ""
    return "it runs kernel-3 networks on a CPU, with a horizon that halves evenly at every level"


ENTRY = Entry(
    name="arranged", summary="torch, the U-Net as matrix products", make=make, unusable=unusable, tolerance=1e-4
)
