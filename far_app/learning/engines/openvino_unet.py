"""The arranged U-Net (fast_unet) and the DDIM chain around it through OpenVINO: one call for a chunk, on CPU.

The graph is built from operations, without a converter, and compiled in a third of a second, for each policy version
anew: its weights are the graph's constants, laid out once as the processor likes them. Given as inputs they would have
to be laid out anew at every step, which then takes two to six times as long. The chain is a loop inside the graph:
asked for step by step, a quarter of the time would go to and from Python, which would wait for the interpreter's lock
in between. Called by openvino_engine.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from far_app.learning.diffusion import ddim_coefficients
from far_app.learning.engines.arranged import ArrangedChain
from far_app.learning.engines.protocol import Push
from far_app.learning.fast_unet import FastUnet

BATCHES = 8
"""Largest batch for which a graph is kept; larger ones are torch's, whose kernels then have enough to do."""


def available() -> bool:
    """Whether the openvino package is installed."""
    return importlib.util.find_spec("openvino") is not None


class OpenVinoChain:
    """far_app.learning.engines.stepwise.Chain of a FastUnet's present weights. Not for several threads at once."""

    def __init__(self, fast: FastUnet, steps: int) -> None:
        self._plain = ArrangedChain(fast, steps)
        self._fast, self._steps = fast, steps
        self._films = fast.leaves[0].detach().numpy()
        self._weights = [np.ascontiguousarray(m.detach().numpy()) for m in fast.leaves[2:]]
        self._requests = {1: self._request(1)}

    def condition(self, features: Float[Tensor, "S F"]) -> Float[Tensor, "S M"]:
        return self._plain.condition(features)

    def sample(
        self, noise: Float[Tensor, "B H A"], condition: Float[Tensor, "B M"], push: Push | None = None
    ) -> Float[Tensor, "B H A"]:
        batch = len(noise)
        if batch > BATCHES or push is not None:
            return self._plain.sample(noise, condition, push)
        if batch not in self._requests:
            self._requests[batch] = self._request(batch)
        request, inputs = self._requests[batch]
        inputs[0][:] = noise.numpy()
        inputs[1][:] = condition.numpy()[:, None]
        request.infer()
        return torch.from_numpy(request.get_output_tensor(0).data.copy())

    def _request(self, batch: int) -> tuple[Any, tuple[np.ndarray, np.ndarray]]:
        """An inference request for this batch, and the inputs it reads."""
        from openvino import Tensor as Shared

        chunk = (batch, self._fast.horizon, self._weights[-1].shape[0])
        graph = _chain(self._fast.unet, chunk, self._films, self._weights, self._steps)
        request = core().compile_model(graph, "CPU", settings("f32")).create_infer_request()
        inputs = np.zeros(chunk, np.float32), np.zeros((batch, 1, self._films.shape[1]), np.float32)
        for i, array in enumerate(inputs):
            request.set_input_tensor(i, Shared(array, shared_memory=True))
        return request, inputs


@functools.cache
def core() -> Any:
    import openvino

    return openvino.Core()


def settings(precision: str) -> dict[str, Any]:
    """One inference as soon as possible, on one thread; precision is "f32" or "bf16". Not pinned: OpenVINO would put
    every inference on the first core, where it waits for whatever else runs there while another core is idle."""
    return {
        "INFERENCE_NUM_THREADS": 1, "PERFORMANCE_HINT": "LATENCY", "INFERENCE_PRECISION_HINT": precision,
        "NUM_STREAMS": 1, "ENABLE_CPU_PINNING": False,
    }  # fmt: skip


def by_tap(matrix: Float[np.ndarray, "O C3"]) -> Float[np.ndarray, "O 3C"]:
    """Columns tap by tap, as `_Builder._taps` lays the inputs side by side; FastUnet has them channel by channel."""
    return np.ascontiguousarray(matrix.reshape(len(matrix), -1, 3).swapaxes(1, 2)).reshape(len(matrix), -1)


def _chain(
    unet: Any, chunk: tuple[int, int, int], films: Float[np.ndarray, "K M"], weights: Sequence[np.ndarray], steps: int
) -> Any:
    """far_app.learning.diffusion.ddim_sample as a graph: (noise (B, H, A), condition (B, 1, M)) → chunks. `films`: the
    diffusion steps' part of FiLM."""
    import openvino
    from openvino import opset13

    ops: Any = opset13
    make: Any = openvino.Model
    batch, film = chunk[0], films.shape[1]
    noisy, here, condition, roots = (
        ops.parameter(list(shape), np.float32) for shape in (chunk, (1, 1, film), (batch, 1, film), (1, 4))
    )
    epsilon = _Builder(unet, noisy, ops.add(here, condition), weights).graph()
    root_a, root_na, root_b, root_nb = ops.split(roots, 1, 4).outputs()
    clean = ops.clamp(ops.divide(ops.subtract(noisy, ops.multiply(root_na, epsilon)), root_a), -1.0, 1.0)
    epsilon = ops.divide(ops.subtract(noisy, ops.multiply(root_a, clean)), root_na)
    result = ops.result(ops.add(ops.multiply(root_b, clean), ops.multiply(root_nb, epsilon)))

    noise, given = (ops.parameter(list(shape), np.float32) for shape in (chunk, (batch, 1, film)))
    visited = ddim_coefficients(steps)
    loop = ops.tensor_iterator()
    loop.set_body(make([result], [noisy, here, condition, roots], "step"))
    loop.set_merged_input(noisy, noise.output(0), result.output(0))
    loop.set_invariant_input(condition, given.output(0))
    each = [k for k, *_ in visited], [coefficients for _, *coefficients in visited]
    for parameter, rows in ((here, films[each[0]][:, None]), (roots, np.array(each[1], np.float32))):
        loop.set_sliced_input(parameter, ops.constant(rows).output(0), 0, 1, 1, -1, 0)
    return make([ops.result(loop.get_iter_value(result.output(0), -1))], [noise, given], "chain")


class _Builder:
    """FastUnet.filmed, operation by operation."""

    def __init__(self, unet: Any, noisy: Any, film: Any, weights: Sequence[np.ndarray]) -> None:
        """`noisy`: (B, H, A), `film`: (B, 1, M), both of the graph."""
        from openvino import opset13

        self.ops: Any = opset13
        self.unet, self.noisy, self.film, self.weights = unet, noisy, film, weights
        self.batch = int(noisy.get_output_shape(0)[0])

    def graph(self) -> Any:
        """ε_θ."""
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
