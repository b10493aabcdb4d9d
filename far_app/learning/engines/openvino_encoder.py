"""A camera's network (far_app/learning/encoder.py) through OpenVINO, one picture at a time.

The graph is built from operations, without a converter: a quarter of a second where tracing takes two. The weights are
its constants: encoders are frozen while a policy acts. GroupNorm is written as MVN over a group, then scale and offset;
OpenVINO 2026.4's own GroupNormalization takes the process down when a residual network compiles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from far_app.errors import FarError
from far_app.learning.encoder import LightCamera, ObservationEncoder, ResNet18Camera, SpatialSoftmax
from far_app.learning.engines.openvino_unet import core, settings
from far_app.learning.engines.stepwise import Look


class CompiledCameras:
    """An encoder's camera networks, ready for any number of threads, each with an OpenVinoCameras of its own."""

    def __init__(self, encoder: ObservationEncoder, image_size: int, precision: str) -> None:
        self._size, self._shared = image_size, not encoder.per_frame
        self._compiled: dict[tuple[str, int], Any] = {
            (camera, place): core().compile_model(camera_graph(net, image_size), "CPU", settings(precision))
            for camera in encoder.camera_names
            for place, net in enumerate(encoder.networks(camera))
        }

    def looking(self, together: bool = False) -> OpenVinoCameras:
        """`together`: all looks at once, a core each: quicker than one after the other."""
        requests = {key: _request(compiled, self._size) for key, compiled in self._compiled.items()}
        return OpenVinoCameras(requests, self._shared, together)


class OpenVinoCameras:
    """far_app.learning.engines.stepwise.CameraFeatures through OpenVINO. Not for several threads at once."""

    def __init__(
        self, requests: Mapping[tuple[str, int], tuple[Any, np.ndarray]], shared: bool, together: bool
    ) -> None:  # fmt: skip
        """`requests` by camera and place in the history; `shared`: every place has the first one's network."""
        self._requests, self._shared, self._together = requests, shared, together

    def __call__(self, looks: Sequence[Look]) -> list[Float[Tensor, "B D"]]:
        requests = self._of(looks)
        rows = []
        for pictures in zip(*(images.numpy() for _, _, images in looks), strict=True):
            for (request, pixels), picture in zip(requests, pictures, strict=True):
                pixels[0] = picture
                if self._together:
                    request.start_async()
                else:
                    request.infer()
            rows.append(_results(requests, wait=self._together))
        return [torch.from_numpy(np.concatenate(look)) for look in zip(*rows, strict=True)]

    def begin(self, looks: Sequence[Look]) -> Callable[[], list[Float[Tensor, "1 D"]]]:
        """far_app.learning.engines.stepwise.Begin, of one picture each, on threads of OpenVINO's own."""
        requests = self._of(looks)
        for (request, pixels), (_, _, images) in zip(requests, looks, strict=True):
            pixels[:] = images.numpy()
            request.start_async()
        return lambda: [torch.from_numpy(row) for row in _results(requests, wait=True)]

    def _of(self, looks: Sequence[Look]) -> list[tuple[Any, np.ndarray]]:
        return [self._requests[camera, 0 if self._shared else place] for camera, place, _ in looks]


def _results(requests: Sequence[tuple[Any, np.ndarray]], wait: bool) -> list[np.ndarray]:
    if wait:
        for request, _ in requests:
            request.wait()
    return [request.get_output_tensor(0).data.copy() for request, _ in requests]


def _request(compiled: Any, size: int) -> tuple[Any, np.ndarray]:
    """An inference request and the picture it reads."""
    import openvino

    request = compiled.create_infer_request()
    pixels = np.zeros((1, size, size, 3), np.uint8)
    request.set_input_tensor(0, openvino.Tensor(pixels, shared_memory=True))
    return request, pixels


def camera_graph(net: nn.Module, size: int) -> Any:
    """uint8 (1, S, S, 3) → features (1, D). FarError for a network that is not one of encoder.py's."""
    import openvino
    from openvino import opset13 as ops

    pixels = ops.parameter([1, size, size, 3], np.uint8, name="pixels")
    x = ops.transpose(ops.convert(pixels, "f32"), [0, 3, 1, 2])
    build = _Layers(ops)
    if isinstance(net, LightCamera):
        x = ops.subtract(ops.multiply(x, np.float32(1 / 127.5)), np.float32(1))
        x = build.positions(build.sequence(x, net.net), net.softmax)
    elif isinstance(net, ResNet18Camera):
        x = ops.multiply(ops.subtract(ops.multiply(x, np.float32(1 / 255)), build.constant(net.mean)),
                         build.constant(1 / net.std))  # fmt: skip
        x = ops.relu(build.norm(build.convolution(x, net.conv1), net.bn1))
        x = ops.max_pool(x, [2, 2], [1, 1], [1, 1], [1, 1], [3, 3]).output(0)
        for layer in (net.layer1, net.layer2, net.layer3, net.layer4):
            for block in layer:
                x = build.residual(x, block)
        x = build.positions(build.convolution(x, net.keypoints), net.softmax)
        x = ops.add(ops.matmul(x, build.constant(net.head.weight), False, True), build.constant(net.head.bias))
    else:
        raise FarError(f"{type(net).__name__} is no camera network that the openvino engine knows; take another engine")
    make: Any = openvino.Model
    return make([x], [pixels], "camera")


class _Layers:
    """Torch's layers as OpenVINO's operations; x is (1, C, H, W)."""

    def __init__(self, ops: Any) -> None:
        self.ops = ops

    def constant(self, weight: Tensor) -> Any:
        return self.ops.constant(np.ascontiguousarray(weight.detach().numpy()))

    def convolution(self, x: Any, layer: nn.Conv2d) -> Any:
        padding, stride = list(layer.padding), list(layer.stride)
        y = self.ops.convolution(x, self.constant(layer.weight), stride, padding, padding, list(layer.dilation))
        return y if layer.bias is None else self.ops.add(y, self.constant(layer.bias.view(1, -1, 1, 1)))

    def norm(self, x: Any, layer: nn.Module) -> Any:
        """GroupNorm, or BatchNorm as it is in evaluation."""
        ops = self.ops
        if isinstance(layer, nn.GroupNorm):
            shape = list(x.output(0).get_shape())
            flat = ops.reshape(x, [1, layer.num_groups, -1], special_zero=False)
            normal = ops.mvn(flat, [2], True, layer.eps, "INSIDE_SQRT")
            y, scale, offset = ops.reshape(normal, shape, special_zero=False), layer.weight, layer.bias
        else:
            batch: Any = layer
            y, scale = x, batch.weight * torch.rsqrt(batch.running_var + batch.eps)
            offset = batch.bias - batch.running_mean * scale
        return ops.add(ops.multiply(y, self.constant(scale.view(1, -1, 1, 1))), self.constant(offset.view(1, -1, 1, 1)))

    def residual(self, x: Any, block: Any) -> Any:
        down = block.downsample
        shortcut = x if down is None else self.norm(self.convolution(x, down[0]), down[1])
        y = self.ops.relu(self.norm(self.convolution(x, block.conv1), block.bn1))
        y = self.norm(self.convolution(y, block.conv2), block.bn2)
        return self.ops.relu(self.ops.add(y, shortcut))

    def sequence(self, x: Any, layers: nn.Sequential) -> Any:
        for layer in layers:
            x = self.convolution(x, layer) if isinstance(layer, nn.Conv2d) else self.ops.relu(x)
        return x

    def positions(self, maps: Any, softmax: SpatialSoftmax) -> Any:
        """(1, C, H, W) → (1, 2C): the mean coordinate under each map's softmax."""
        ops, channels = self.ops, int(maps.output(0).get_shape()[1])
        weights = ops.softmax(ops.reshape(maps, [1, channels, -1], special_zero=False), 2)
        return ops.reshape(ops.matmul(weights, self.constant(softmax.grid), False, False), [1, 2 * channels],
                           special_zero=False)  # fmt: skip
