"""The arranged U-Net (fast_unet) through OpenVINO: one denoising step, some two and a half times as fast on CPU.

The graph is built once for an architecture and a batch size, from operations, without a converter; the weights are its
inputs, not its constants, so that an adapted policy runs on its own weights at once, with nothing compiled anew.
Called by openvino_engine.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from far_app.learning.fast_unet import FastUnet

BATCHES = 8
"""Largest batch for which a graph is kept; larger ones are torch's, whose kernels then have enough to do."""


def available() -> bool:
    """Whether the openvino package is installed."""
    return importlib.util.find_spec("openvino") is not None


class OpenVinoUnet:
    """A FastUnet's `condition` and `run`, the latter through OpenVINO for small batches. Not for several threads at
    once; the weights are those that the FastUnet held when this was made."""

    def __init__(self, fast: FastUnet, threads: int = 1) -> None:
        self.fast, self.threads = fast, threads
        self._films = fast.leaves[0].detach()
        self._weights = [np.ascontiguousarray(m.detach().numpy()) for m in fast.leaves[2:]]
        self._requests: dict[int, Any] = {}

    def condition(self, features: Float[Tensor, "S F"]) -> Float[Tensor, "S M"]:
        return self.fast.condition(features)

    def run(
        self, noisy: Float[Tensor, "B H A"], k: Int[Tensor, "B"], condition: Float[Tensor, "B M"]
    ) -> Float[Tensor, "B H A"]:
        """ε_θ(a_k, s, k), the observation given by its `condition`."""
        batch = len(noisy)
        if batch > BATCHES:
            return self.fast.run(noisy, k, condition)
        if batch not in self._requests:
            self._requests[batch] = self._request(batch)
        request, inputs = self._requests[batch]
        inputs[0][:] = noisy.numpy()
        inputs[1][:] = (self._films[k] + condition).numpy()[:, None]
        request.infer()
        return torch.from_numpy(request.get_output_tensor(0).data.copy())

    def _request(self, batch: int) -> tuple[Any, tuple[np.ndarray, np.ndarray]]:
        """An inference request of the shared graph that reads these weights where they lie."""
        from openvino import Tensor as Shared

        action_dim = self._weights[-1].shape[0]
        shapes = tuple(w.shape for w in self._weights)
        compiled = _compiled(
            self.fast.unet, (batch, self.fast.horizon, action_dim), self._films.shape[1], shapes, self.threads
        )
        request = compiled.create_infer_request()
        own = (
            np.zeros((batch, self.fast.horizon, action_dim), np.float32),
            np.zeros((batch, 1, self._films.shape[1]), np.float32),
        )
        for i, array in enumerate((*own, *self._weights)):
            request.set_input_tensor(i, Shared(array, shared_memory=True))
        return request, own


_GRAPHS: dict[tuple[Any, ...], Any] = {}


def _compiled(
    unet: Any, chunk: tuple[int, int, int], film: int, shapes: Sequence[tuple[int, ...]], threads: int
) -> Any:
    """The compiled graph of this architecture; one for all of its weights."""
    key = (repr(unet), chunk, film, tuple(shapes), threads)
    if key not in _GRAPHS:
        graph = _Builder(unet, chunk, film, shapes).model()
        _GRAPHS[key] = core().compile_model(graph, "CPU", settings("f32", threads))
    return _GRAPHS[key]


@functools.cache
def core() -> Any:
    import openvino

    return openvino.Core()


def settings(precision: str, threads: int) -> dict[str, Any]:
    """One inference as soon as possible, on so many threads; precision is "f32" or "bf16"."""
    return {
        "INFERENCE_NUM_THREADS": threads, "PERFORMANCE_HINT": "LATENCY", "INFERENCE_PRECISION_HINT": precision,
        "NUM_STREAMS": 1,
    }  # fmt: skip


class _Builder:
    """FastUnet.run, operation by operation."""

    def __init__(self, unet: Any, chunk: tuple[int, int, int], film: int, shapes: Sequence[tuple[int, ...]]) -> None:
        from openvino import opset13

        self.ops: Any = opset13
        self.unet = unet
        self.noisy = self.ops.parameter(list(chunk), np.float32, name="noisy")
        self.film = self.ops.parameter([chunk[0], 1, film], np.float32, name="film")
        self.weights = [self.ops.parameter(list(s), np.float32, name=f"weight_{i}") for i, s in enumerate(shapes)]
        self.batch = chunk[0]

    def model(self) -> Any:
        import openvino

        make: Any = openvino.Model
        return make([self._graph()], [self.noisy, self.film, *self.weights], "denoiser")

    def _graph(self) -> Any:
        ops, u = self.ops, self.unet
        weights = iter(self.weights)
        blocks = [*(b for d in u.downs for b in d[:2]), *u.middle, *(b for d in u.ups for b in d[:2])]
        widths = [2 * b.second[1].num_channels for b in blocks]
        films = iter(ops.variadic_split(self.film, 2, widths).outputs())
        x: Any = self.noisy
        skips: list[Any] = []
        for first, second, shrink in u.downs:
            x = self._residual(self._residual(x, first, weights, next(films)), second, weights, next(films))
            skips.append(x)
            if isinstance(shrink, nn.Conv1d):
                every_other = ops.slice(self._taps(x), [0], [np.iinfo(np.int32).max], [2], [1])
                x = self._affine(every_other, next(weights), next(weights))
        for block in u.middle:
            x = self._residual(x, block, weights, next(films))
        for first, second, _ in u.ups:
            x = ops.concat([x, skips.pop()], 2)
            x = self._residual(self._residual(x, first, weights, next(films)), second, weights, next(films))
            length = self._length(x)
            x = self._affine(self._taps(x), next(weights), next(weights))
            x = ops.reshape(x, [self.batch, 2 * length, -1], special_zero=False)
        x = self._convolved(x, u.out[0], weights)
        return self._affine(x, next(weights), next(weights))

    @staticmethod
    def _length(x: Any) -> int:
        return int((x if hasattr(x, "get_shape") else x.output(0)).get_shape()[1])

    def _taps(self, x: Any) -> Any:
        """Every step beside its neighbours; zeros past the ends."""
        ops, length = self.ops, self._length(x)
        padded = ops.pad(x, [0, 1, 0], [0, 1, 0], "constant", np.float32(0))
        return ops.concat([ops.slice(padded, [i], [i + length], [1], [1]) for i in range(3)], 2)

    def _affine(self, x: Any, matrix: Any, bias: Any) -> Any:
        return self.ops.add(self.ops.matmul(x, matrix, False, False), bias)

    def _convolved(self, x: Any, block: Any, weights: Iterator[Any]) -> Any:
        """Conv → GroupNorm → Mish."""
        ops = self.ops
        matrix, bias, scale, offset = (next(weights) for _ in range(4))
        if self._length(x) == 2:
            flat = ops.reshape(x, [self.batch, -1], special_zero=False)
            x = ops.reshape(self._affine(flat, matrix, bias), [self.batch, 2, -1], special_zero=False)
        else:
            x = self._affine(self._taps(x), matrix, bias)
        return ops.mish(ops.add(ops.multiply(self._normalised(x, block[1]), scale), offset))

    def _normalised(self, x: Any, norm: nn.GroupNorm) -> Any:
        """Mean 0 and variance 1 in each group of channels. OpenVINO 2026.4's own GroupNormalization takes the process
        down when some residual networks compile."""
        ops, length = self.ops, self._length(x)
        grouped = ops.reshape(x, [self.batch, length, norm.num_groups, -1], special_zero=False)
        normal = ops.mvn(grouped, [1, 3], True, norm.eps, "INSIDE_SQRT")
        return ops.reshape(normal, [self.batch, length, norm.num_channels], special_zero=False)

    def _residual(self, x: Any, block: Any, weights: Iterator[Any], film: Any) -> Any:
        ops = self.ops
        scale, shift = ops.split(film, 2, 2).outputs()
        h = ops.add(ops.multiply(self._convolved(x, block.first, weights), scale), shift)
        h = self._convolved(h, block.second, weights)
        if isinstance(block.skip, nn.Conv1d):
            x = self._affine(x, next(weights), next(weights))
        return ops.add(h, x)
