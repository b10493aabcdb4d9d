"""Observation encoders: camera frames and proprioception to one feature vector.

`paper`: a ResNet-18 for each view and each frame, spatial softmax over 64 maps, a linear layer to 64 (appendix,
Network Architecture). `quickstart`: a three-layer CNN for each view, shared over the frames, so that two cores train it
and the previous frame's features can be kept.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn


class SpatialSoftmax(nn.Module):
    """Where each feature map fires: the mean image coordinate under its softmax, in [−1, 1] (Levine et al. 2016)."""

    grid: Tensor

    def __init__(self, height: int, width: int) -> None:
        super().__init__()
        ys, xs = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
        self.register_buffer("grid", torch.stack([xs.flatten(), ys.flatten()], dim=-1), persistent=False)

    def forward(self, maps: Float[Tensor, "B C H W"]) -> Float[Tensor, "B 2C"]:
        with torch.autocast(maps.device.type, enabled=False):  # places are found to a hundredth of a pixel
            weights = maps.float().flatten(2).softmax(dim=-1)
            return (weights @ self.grid).flatten(1)


class LightCamera(nn.Module):
    """84 × 84 pixels to 32 keypoints, about 8 M multiply-adds a frame."""

    def __init__(self, image_size: int, maps: int = 32) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.Conv2d(3, 16, 5, stride=2, padding=2), nn.ReLU(),
            nn.Conv2d(16, 32, 3, stride=2, padding=1), nn.ReLU(),
            nn.Conv2d(32, maps, 3, padding=1),
        )  # fmt: skip
        side = -(-image_size // 4)
        self.softmax = SpatialSoftmax(side, side)
        self.dim = 2 * maps

    def forward(self, image: Float[Tensor, "B 3 S S"]) -> Float[Tensor, "B D"]:
        return self.positions(self.maps(image))

    def maps(self, image: Float[Tensor, "B 3 S S"]) -> Float[Tensor, "B C H W"]:
        """All convolutions."""
        return self.net(image)

    def positions(self, maps: Float[Tensor, "B C H W"]) -> Float[Tensor, "B D"]:
        """What follows them."""
        return self.softmax(maps)


class BasicBlock(nn.Module):
    """ResNet's two-layer block; attribute names are torchvision's, so that its ImageNet weights load."""

    def __init__(self, inner: int, outer: int, stride: int, norm: type[nn.Module]) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inner, outer, 3, stride=stride, padding=1, bias=False)
        self.bn1 = norm(outer)
        self.conv2 = nn.Conv2d(outer, outer, 3, padding=1, bias=False)
        self.bn2 = norm(outer)
        self.downsample = (
            nn.Sequential(nn.Conv2d(inner, outer, 1, stride=stride, bias=False), norm(outer))
            if stride != 1 or inner != outer
            else None
        )

    def forward(self, x: Tensor) -> Tensor:
        shortcut = x if self.downsample is None else self.downsample(x)
        x = torch.relu(self.bn1(self.conv1(x)))
        return torch.relu(self.bn2(self.conv2(x)) + shortcut)


class GroupNorm16(nn.GroupNorm):
    """GroupNorm of 16 channels a group, in BatchNorm's place."""

    def __init__(self, channels: int) -> None:
        super().__init__(max(1, channels // 16), channels)


class ResNet18Camera(nn.Module):
    """ResNet-18 without its classifier; pictures at their own size, spatial softmax over 64 maps, linear to 64.

    State-dict names of the trunk are torchvision's.
    """

    mean: Tensor
    std: Tensor
    layer1: nn.Sequential
    layer2: nn.Sequential
    layer3: nn.Sequential
    layer4: nn.Sequential

    def __init__(self, image_size: int, maps: int = 64, out: int = 64, norm: str = "group") -> None:
        super().__init__()
        layer: type[nn.Module] = GroupNorm16 if norm == "group" else nn.BatchNorm2d
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = layer(64)
        self.maxpool = nn.MaxPool2d(3, stride=2, padding=1)
        for i, (inner, outer, stride) in enumerate(((64, 64, 1), (64, 128, 2), (128, 256, 2), (256, 512, 2)), 1):
            blocks = nn.Sequential(BasicBlock(inner, outer, stride, layer), BasicBlock(outer, outer, 1, layer))
            setattr(self, f"layer{i}", blocks)
        self.keypoints = nn.Conv2d(512, maps, 1)
        side = -(-image_size // 32)
        self.softmax = SpatialSoftmax(side, side)
        self.head = nn.Linear(2 * maps, out)
        self.register_buffer("mean", torch.tensor([0.485, 0.456, 0.406]).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor([0.229, 0.224, 0.225]).view(1, 3, 1, 1), persistent=False)
        self.dim = out

    def forward(self, image: Float[Tensor, "B 3 S S"]) -> Float[Tensor, "B D"]:
        return self.positions(self.maps(image))

    def maps(self, image: Float[Tensor, "B 3 S S"]) -> Float[Tensor, "B C H W"]:
        """All convolutions."""
        x = ((image + 1.0) / 2.0 - self.mean) / self.std
        x = self.maxpool(torch.relu(self.bn1(self.conv1(x))))
        return self.keypoints(self.layer4(self.layer3(self.layer2(self.layer1(x)))))

    def positions(self, maps: Float[Tensor, "B C H W"]) -> Float[Tensor, "B D"]:
        """What follows them."""
        return self.head(self.softmax(maps))


class ObservationEncoder(nn.Module):
    """Images (uint8) of every camera and frame, and the normalised state, to features (B, F)."""

    def __init__(
        self, kind: str, cameras: tuple[str, ...], image_size: int, n_obs: int, state_dim: int, norm: str
    ) -> None:
        super().__init__()
        self.kind, self.camera_names, self.n_obs = kind, cameras, n_obs
        self.per_frame = kind == "resnet18"
        count = n_obs if self.per_frame else 1

        def make() -> nn.Module:
            return ResNet18Camera(image_size, norm=norm) if self.per_frame else LightCamera(image_size)

        self.nets = nn.ModuleDict({c: nn.ModuleList(make() for _ in range(count)) for c in cameras})
        self.frame_dim: int = self._net(cameras[0], 0).dim if cameras else 0
        self.dim = n_obs * (len(cameras) * self.frame_dim + state_dim)

    def networks(self, camera: str) -> list[Any]:
        """Of a camera: one for each place in the history, oldest first, or one for all."""
        nets: Any = self.nets[camera]
        return list(nets)

    def _net(self, camera: str, index: int) -> Any:
        nets: Any = self.nets[camera]
        return nets[index]

    def camera_features(self, camera: str, frame: int, images: UInt8[Tensor, "B S S 3"]) -> Float[Tensor, "B D"]:
        """Features of one camera's pictures at one place in the history (0 oldest)."""
        net = self._net(camera, frame if self.per_frame else 0)
        return net(images.permute(0, 3, 1, 2).float().mul_(1 / 127.5).sub_(1.0))

    def forward(
        self, images: dict[str, UInt8[Tensor, "B T S S 3"]], state: Float[Tensor, "B T D"]
    ) -> Float[Tensor, "B F"]:
        return self.join([[self.camera_features(c, t, images[c][:, t]) for c in self.camera_names]
                          for t in range(self.n_obs)], state)  # fmt: skip

    def join(self, frames: list[list[Tensor]], state: Float[Tensor, "B T D"]) -> Float[Tensor, "B F"]:
        """Per-frame, per-camera features and the state, in the order the denoiser knows."""
        parts = [part for t in range(self.n_obs) for part in (*frames[t], state[:, t])]
        return torch.cat(parts, dim=-1)
