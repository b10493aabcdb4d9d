"""OpenVINO on a CPU: camera networks and U-Net steps as its graphs, the DDIM loop around them in torch.

Some three times as fast as the reference; an optional extra of the package (`pip install openvino`). One graph a
denoising step is faster than all steps unrolled into one (16 steps: 10 ms against 16, and a tenth of the time to
compile), and it takes an adapted policy's weights as they are, with nothing compiled anew.
"""

from __future__ import annotations

from functools import partial

from far_app.learning.engines.arranged import unusable as unarranged
from far_app.learning.engines.openvino_encoder import OpenVinoCameras
from far_app.learning.engines.openvino_unet import OpenVinoUnet, available
from far_app.learning.engines.protocol import EngineError, Entry
from far_app.learning.engines.stepwise import Frames, StepwiseEngine
from far_app.learning.fast_unet import FastUnet
from far_app.learning.policy import DiffusionPolicy


def make(
    network: DiffusionPolicy, version: str, each_alone: bool, *, name: str = "openvino", precision: str = "f32"
) -> StepwiseEngine:
    """`precision` is that of the camera networks; the U-Net stays in f32, whose weights as inputs bf16 only converts
    anew at every step: no faster, and an error that sixteen steps add up."""

    def unet(network: DiffusionPolicy) -> OpenVinoUnet:
        return OpenVinoUnet(FastUnet(network.denoiser, network.config.horizon))

    try:
        cameras = OpenVinoCameras(network.encoder, network.config.image_size, precision)
        return StepwiseEngine(name, network, version, Frames(network, cameras, each_alone), unet)
    except (ImportError, RuntimeError) as error:
        raise EngineError(f"OpenVINO could not build it: {error}") from error


def unusable(network: DiffusionPolicy) -> str:
    return unarranged(network) or ("" if available() else "the package is not installed; run pip install openvino")


def not_lowered(network: DiffusionPolicy) -> str:
    return unusable(network) or ("" if network.config.cameras else "the policy has no cameras whose networks it lowers")


ENTRY = Entry(name="openvino", summary="OpenVINO, f32", make=make, unusable=unusable, tolerance=1e-4)
BF16_ENTRY = Entry(
    name="openvino-bf16", summary="OpenVINO, camera networks in bf16", unusable=not_lowered, tolerance=5e-2,
    make=partial(make, name="openvino-bf16", precision="bf16"), automatic=False,
)  # fmt: skip
