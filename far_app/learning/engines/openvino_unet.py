"""The arranged U-Net (fast_unet) through OpenVINO: one denoising step, six times as fast on CPU.

The graph is built from operations, without a converter, and compiled in a quarter of a second, for each policy version
anew: its weights are the graph's constants, laid out once as the processor likes them. Given as inputs they would have
to be laid out anew at every step, which then takes two to six times as long. Called by openvino_engine.
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
        self._requests = {1: self._request(1)}

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
        """An inference request for this batch, and the inputs it reads."""
        from openvino import Tensor as Shared

        chunk = (batch, self.fast.horizon, self._weights[-1].shape[0])
        graph = _Builder(self.fast.unet, chunk, self._films.shape[1], self._weights).model()
        request = core().compile_model(graph, "CPU", settings("f32", self.threads)).create_infer_request()
        inputs = np.zeros(chunk, np.float32), np.zeros((batch, 1, self._films.shape[1]), np.float32)
        for i, array in enumerate(inputs):
            request.set_input_tensor(i, Shared(array, shared_memory=True))
        return request, inputs


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


def by_tap(matrix: Float[np.ndarray, "O C3"]) -> Float[np.ndarray, "O 3C"]:
    """Columns tap by tap, as `_Builder._taps` lays the inputs side by side; FastUnet has them channel by channel."""
    return np.ascontiguousarray(matrix.reshape(len(matrix), -1, 3).swapaxes(1, 2)).reshape(len(matrix), -1)


class _Builder:
    """FastUnet.run, operation by operation."""

    def __init__(self, unet: Any, chunk: tuple[int, int, int], film: int, weights: Sequence[np.ndarray]) -> None:
        from openvino import opset13

        self.ops: Any = opset13
        self.unet = unet
        self.noisy = self.ops.parameter(list(chunk), np.float32, name="noisy")
        self.film = self.ops.parameter([chunk[0], 1, film], np.float32, name="film")
        self.weights = weights
        self.batch = chunk[0]

    def model(self) -> Any:
        import openvino

        make: Any = openvino.Model
        return make([self._graph()], [self.noisy, self.film], "denoiser")

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
                x = self._affine(every_other, by_tap(next(weights)), next(weights))
        for block in u.middle:
            x = self._residual(x, block, weights, next(films))
        for first, second, _ in u.ups:
            x = ops.concat([x, skips.pop()], 2)
            x = self._residual(self._residual(x, first, weights, next(films)), second, weights, next(films))
            length = self._length(x)
            x = self._affine(self._taps(x), by_tap(next(weights)), next(weights))
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

    def _affine(self, x: Any, matrix: np.ndarray, bias: np.ndarray) -> Any:
        return self.ops.add(self.ops.matmul(x, self.ops.constant(matrix), False, True), self.ops.constant(bias))

    def _convolved(self, x: Any, block: Any, weights: Iterator[np.ndarray]) -> Any:
        """Conv → GroupNorm → Mish."""
        ops = self.ops
        matrix, bias, scale, offset = (next(weights) for _ in range(4))
        if self._length(x) == 2:
            flat = ops.reshape(x, [self.batch, -1], special_zero=False)
            x = ops.reshape(self._affine(flat, matrix, bias), [self.batch, 2, -1], special_zero=False)
        else:
            x = self._affine(self._taps(x), by_tap(matrix), bias)
        scaled = ops.multiply(self._normalised(x, block[1]), ops.constant(scale))
        return ops.mish(ops.add(scaled, ops.constant(offset)))

    def _normalised(self, x: Any, norm: nn.GroupNorm) -> Any:
        """Mean 0 and variance 1 in each group of channels. OpenVINO 2026.4's own GroupNormalization takes the process
        down when some residual networks compile."""
        ops, length = self.ops, self._length(x)
        grouped = ops.reshape(x, [self.batch, length, norm.num_groups, -1], special_zero=False)
        normal = ops.mvn(grouped, [1, 3], True, norm.eps, "INSIDE_SQRT")
        return ops.reshape(normal, [self.batch, length, norm.num_channels], special_zero=False)

    def _residual(self, x: Any, block: Any, weights: Iterator[np.ndarray], film: Any) -> Any:
        ops = self.ops
        scale, shift = ops.split(film, 2, 2).outputs()
        h = ops.add(ops.multiply(self._convolved(x, block.first, weights), scale), shift)
        h = self._convolved(h, block.second, weights)
        if isinstance(block.skip, nn.Conv1d):
            x = self._affine(x, next(weights), next(weights))
        return ops.add(h, x)
