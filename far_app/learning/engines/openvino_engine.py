"""OpenVINO on a CPU: camera networks and U-Net steps as its graphs, the DDIM loop around them in torch.

An optional extra of the package (`pip install openvino`). One graph a denoising step is compiled in a tenth of the time
that all steps unrolled into one would take, which is what an adapted policy waits for while the arm goes home.
"""

from __future__ import annotations

import os
from functools import partial

from far_app.learning.engines.arranged import unusable as unarranged
from far_app.learning.engines.openvino_encoder import CompiledCameras
from far_app.learning.engines.openvino_unet import OpenVinoChain, available
from far_app.learning.engines.protocol import EngineError, Entry
from far_app.learning.engines.stepwise import Frames, StepwiseEngine
from far_app.learning.fast_unet import FastUnet
from far_app.learning.policy import DiffusionPolicy


def make(
    network: DiffusionPolicy, version: str, each_alone: bool, *, name: str = "openvino", precision: str = "f32"
) -> StepwiseEngine:
    """`precision` is that of the camera networks; the U-Net stays in f32: bf16 makes a step a sixth faster, and an
    error that sixteen steps add up."""

    def chain(network: DiffusionPolicy) -> OpenVinoChain:
        return OpenVinoChain(FastUnet(network.denoiser, network.config.horizon), network.config.ddim_steps)

    try:
        together = worth_sharing(network) and not each_alone
        cameras = CompiledCameras(network.encoder, network.config.image_size, precision)
        looking = cameras.looking(together)
        begin = looking.begin if together else None
        frames = Frames(network, looking, each_alone, another=partial(cameras.looking, together), begin=begin)
        return StepwiseEngine(name, network, version, frames, chain)
    except (ImportError, RuntimeError) as error:
        raise EngineError(f"OpenVINO could not build it: {error}") from error


def worth_sharing(network: DiffusionPolicy) -> bool:
    """Whether its camera networks look at the same time, each on a core of its own: the paper's, which take a tick one
    after the other. Others are too short to be handed to another thread, and so is a U-Net step."""
    return network.config.encoder == "resnet18" and (os.cpu_count() or 1) > 1


def unusable(network: DiffusionPolicy) -> str:
    return unarranged(network) or ("" if available() else "the package is not installed; run pip install openvino")


def not_lowered(network: DiffusionPolicy) -> str:
    return unusable(network) or ("" if network.config.cameras else "the policy has no cameras whose networks it lowers")


ENTRY = Entry(name="openvino", summary="OpenVINO, f32", make=make, unusable=unusable, tolerance=1e-4)
BF16_ENTRY = Entry(
    name="openvino-bf16", summary="OpenVINO, camera networks in bf16", unusable=not_lowered, tolerance=5e-2,
    make=partial(make, name="openvino-bf16", precision="bf16"), automatic=False,
)  # fmt: skip
