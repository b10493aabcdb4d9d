"""Torch without the reference's waste: the U-Net as a few matrix products (fast_unet), frames encoded once. CPU."""

from __future__ import annotations

from far_app.learning.engines.protocol import Entry
from far_app.learning.engines.stepwise import Frames, StepwiseEngine
from far_app.learning.fast_unet import FastUnet, arrangeable
from far_app.learning.policy import DiffusionPolicy


def make(network: DiffusionPolicy, version: str, each_alone: bool) -> StepwiseEngine:
    frames = Frames(network, network.encoder.camera_features, each_alone)
    return StepwiseEngine("arranged", network, version, frames, arranged_unet)


def arranged_unet(network: DiffusionPolicy) -> FastUnet:
    return FastUnet(network.denoiser, network.config.horizon)


def unusable(network: DiffusionPolicy) -> str:
    if arrangeable(network.denoiser, network.config.horizon) is not None:
        return ""
    return "it runs kernel-3 networks on a CPU, with a horizon that halves evenly at every level"


ENTRY = Entry(
    name="arranged", summary="torch, the U-Net as matrix products", make=make, unusable=unusable, tolerance=1e-4
)
