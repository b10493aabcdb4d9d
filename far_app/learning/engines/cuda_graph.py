"""CUDA graphs: encoder and all DDIM steps as one launch for each batch size.

What an eager pass spends on a GPU is mostly the launching of some thousand small kernels; a captured graph replays them
at once from static buffers. What does not change from tick to tick is computed beforehand: the diffusion steps' part of
every FiLM and the U-Net's matrices (fast_unet). Camera networks run channels-last in bf16 on a GPU, up to the spatial
softmax, which keeps f32. On a CPU the same program runs eagerly in the precision that is asked for, which is how its
buffers and precomputed parts are tested where there is no GPU.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from far_app.learning.diffusion import ddim_coefficients, ddim_sample
from far_app.learning.engines.protocol import EngineError, Entry, Push
from far_app.learning.fast_unet import FastUnet, fits
from far_app.learning.memory import Encode
from far_app.learning.policy import DiffusionPolicy
from far_app.protocols import History

Shapes = dict[str, tuple[tuple[int, ...], torch.dtype]]
"""Of a program's inputs, by name."""
WARM_UP = 3
"""Eager passes before a capture: libraries choose their kernels and reserve their workspaces in them."""
FLOAT_PARTS = ("softmax", "head")
"""Of a camera network: what stays in f32."""


class Program:
    """A computation on static buffers: captured once on a GPU, run eagerly on a CPU."""

    def __init__(self, compute: Callable[[], tuple[Tensor, ...]], device: torch.device) -> None:
        """`compute` reads and makes tensors of fixed shape; it is called under no_grad."""
        self._compute, self._graph = compute, None
        self.outputs: tuple[Tensor, ...] = ()
        if device.type == "cuda":
            self._capture(device)

    def _capture(self, device: torch.device) -> None:
        side = torch.cuda.Stream(device)
        side.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(side):
            for _ in range(WARM_UP):
                self._compute()
        torch.cuda.current_stream(device).wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        # thread_local: another thread may use the GPU meanwhile (the policy acts while an adaptation is captured)
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            self.outputs = self._compute()
        self._graph = graph

    def __call__(self) -> tuple[Tensor, ...]:
        """The outputs; on a GPU they are overwritten by the next call."""
        if self._graph is None:
            self.outputs = self._compute()
        else:
            self._graph.replay()
        return self.outputs


class LowCameras:
    """ObservationEncoder.camera_features, convolutions channels-last in a precision of their own."""

    def __init__(self, network: DiffusionPolicy, dtype: torch.dtype) -> None:
        encoder = network.encoder
        self.dtype = dtype
        self._nets = {c: [lowered(net, dtype) for net in encoder.networks(c)] for c in encoder.camera_names}

    def __call__(self, camera: str, place: int, images: UInt8[Tensor, "B S S 3"]) -> Float[Tensor, "B D"]:
        nets = self._nets[camera]
        net = nets[min(place, len(nets) - 1)]
        pixels = images.permute(0, 3, 1, 2).float().mul_(1 / 127.5).sub_(1.0)  # NHWC in memory: channels-last
        return net.positions(net.maps(pixels.to(self.dtype)).float())


def lowered(net: nn.Module, dtype: torch.dtype) -> Any:
    """A copy of a camera network, channels-last, all but FLOAT_PARTS in this precision."""
    low: Any = copy.deepcopy(net).requires_grad_(False).eval()
    for name, part in low.named_children():
        if name not in FLOAT_PARTS:
            part.to(dtype=dtype, memory_format=torch.channels_last)
    for name, buffer in low.named_buffers(recurse=False):
        low.register_buffer(name, buffer.to(dtype), persistent=False)
    return low


class CudaGraphEngine:
    """far_app.learning.engines.Engine."""

    name = "cuda-graph"

    def __init__(
        self, network: DiffusionPolicy, version: str, dtype: torch.dtype = torch.bfloat16,
        cameras: LowCameras | None = None,
    ) -> None:  # fmt: skip
        """`dtype`: of the camera networks, where `cameras` are not given."""
        self.network, self.version = network, version
        self.device = network.normalizer.low.device
        self._cameras = cameras or LowCameras(network, dtype)
        self._unet = FastUnet(network.denoiser, network.config.horizon)
        self._coefficients = ddim_coefficients(network.config.ddim_steps)
        self._films = self._unet.leaves[0][[k for k, *_ in self._coefficients]]  # (steps, M)
        self._whole: dict[int, Buffers] = {}
        self._denoise: dict[int, Buffers] = {}

    @torch.no_grad()
    def plan(self, histories: Sequence[History], noise: Float[Tensor, "B H A"]) -> tuple[Tensor, Tensor]:
        batch = len(histories)
        if batch not in self._whole:
            self._whole[batch] = self._whole_buffers(batch)
        buffers = self._whole[batch]
        for name, value in self._seen(histories).items():
            buffers.put(name, value)
        buffers.put("noise", noise)
        features, chunks = buffers.program()
        return features.clone(), chunks.clone()

    @torch.no_grad()
    def sample(
        self, features: Float[Tensor, "B F"], noise: Float[Tensor, "B H A"], push: Push | None = None
    ) -> Float[Tensor, "B H A"]:
        if push is not None:  # a function of the caller's cannot be captured
            unet = self._unet
            return ddim_sample(unet.run, unet.condition(features), noise, self.network.config.ddim_steps, push)
        batch = len(features)
        if batch not in self._denoise:
            self._denoise[batch] = self._denoise_buffers(batch)
        buffers = self._denoise[batch]
        buffers.put("features", features)
        buffers.put("noise", noise)
        return buffers.program()[0].clone()

    @torch.no_grad()
    def encode(self, histories: Sequence[History]) -> Float[Tensor, "B F"]:
        config = self.network.config
        noise = torch.zeros(len(histories), config.horizon, self.network.spec().action_dim, device=self.device)
        return self.plan(histories, noise)[0]

    def another_encoder(self) -> Encode:
        """Launched kernel by kernel: an attempt's states come in batches of any size, and each would be captured."""
        return self._eagerly_encoded

    def adapted(self, network: DiffusionPolicy, version: str) -> CudaGraphEngine:
        """Its graphs are captured when they are first asked for: by the check that follows."""
        return CudaGraphEngine(network, version, cameras=self._cameras)

    def _whole_buffers(self, batch: int) -> Buffers:
        network, spec = self.network, self.network.spec()
        size, n_obs = network.config.image_size, network.config.n_obs
        shapes: Shapes = {c: ((batch, n_obs, size, size, 3), torch.uint8) for c in network.config.cameras}
        shapes["states"] = ((batch, n_obs, len(network.normalizer.low)), torch.float32)
        shapes["noise"] = ((batch, spec.horizon, spec.action_dim), torch.float32)

        def compute(inputs: dict[str, Tensor]) -> tuple[Tensor, ...]:
            features = self._features(inputs)
            return features, self._denoised(features, inputs["noise"])

        return Buffers(shapes, compute, self.device)

    @torch.no_grad()
    def _eagerly_encoded(self, histories: Sequence[History]) -> Float[Tensor, "B F"]:
        return self._features({name: value.to(self.device) for name, value in self._seen(histories).items()})

    def _seen(self, histories: Sequence[History]) -> dict[str, Tensor]:
        """Each camera's pictures (B, T, S, S, 3) uint8, and the states (B, T, D)."""
        pictures = {
            c: torch.from_numpy(np.stack([np.stack([o.images[c] for o in h]) for h in histories]))
            for c in self.network.config.cameras
        }
        return {**pictures, "states": self.network.states(histories)}

    def _features(self, inputs: dict[str, Tensor]) -> Float[Tensor, "B F"]:
        """Of what `_seen` gives, on the device."""
        network = self.network
        frames = [
            [self._cameras(c, t, inputs[c][:, t]) for c in network.config.cameras] for t in range(network.config.n_obs)
        ]
        return network.encoder.join(frames, network.normalizer(inputs["states"]))

    def _denoise_buffers(self, batch: int) -> Buffers:
        spec = self.network.spec()
        shapes: Shapes = {
            "features": ((batch, self.network.feature_dim), torch.float32),
            "noise": ((batch, spec.horizon, spec.action_dim), torch.float32),
        }
        return Buffers(shapes, lambda i: (self._denoised(i["features"], i["noise"]),), self.device)

    def _denoised(self, features: Float[Tensor, "B F"], noise: Float[Tensor, "B H A"]) -> Float[Tensor, "B H A"]:
        """ddim_sample with every step's FiLM made beforehand."""
        condition, x = self._unet.condition(features), noise
        for film, (_, root_a, root_na, root_b, root_nb) in zip(self._films, self._coefficients, strict=True):
            epsilon = self._unet.filmed(x, condition + film)
            clean = ((x - root_na * epsilon) / root_a).clamp(-1.0, 1.0)
            x = root_b * clean + root_nb * ((x - root_a * clean) / root_na)
        return x


class Buffers:
    """A program and the inputs it reads, by name."""

    def __init__(
        self, shapes: dict[str, tuple[tuple[int, ...], torch.dtype]],
        compute: Callable[[dict[str, Tensor]], tuple[Tensor, ...]], device: torch.device,
    ) -> None:  # fmt: skip
        self._inputs = {n: torch.zeros(shape, dtype=dtype, device=device) for n, (shape, dtype) in shapes.items()}
        self.program = Program(lambda: compute(self._inputs), device)

    def put(self, name: str, value: Tensor) -> None:
        self._inputs[name].copy_(value)


def unusable(network: DiffusionPolicy) -> str:
    device = network.normalizer.low.device
    if device.type != "cuda":
        return f"the policy is on {device.type}; it runs on an NVIDIA GPU (--device cuda)"
    return "" if fits(network.denoiser, network.config.horizon) else "it runs kernel-3 networks"


def make(network: DiffusionPolicy, version: str, each_alone: bool) -> CudaGraphEngine:
    try:
        return CudaGraphEngine(network, version)
    except RuntimeError as error:
        raise EngineError(f"the graph could not be captured: {error}") from error


ENTRY = Entry(
    name="cuda-graph", summary="one CUDA graph a chunk, camera networks in bf16", make=make, unusable=unusable,
    tolerance=5e-2,
)  # fmt: skip
