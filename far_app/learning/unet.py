"""The denoiser: a conditional 1-D U-Net over the chunk's time axis (Chi et al. 2023; sizes from the paper's appendix).

Down widths [64, 128, 256], kernel 3, a 16-d step embedding, FiLM conditioning of every residual block on
[step embedding, observation features], GroupNorm with 8 groups, Mish.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from far_app.wire import register


class StepEmbedding(nn.Module):
    """Sinusoidal embedding of the diffusion step, then two linear layers."""

    frequencies: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        half = dim // 2
        self.register_buffer("frequencies", torch.exp(torch.arange(half) * -(math.log(10000.0) / (half - 1))))
        self.mlp = nn.Sequential(nn.Linear(dim, 4 * dim), nn.Mish(), nn.Linear(4 * dim, dim))

    def forward(self, k: Tensor) -> Tensor:
        angles = k[:, None].to(self.frequencies.dtype) * self.frequencies[None, :]
        return self.mlp(torch.cat([angles.sin(), angles.cos()], dim=-1))


class ConvBlock(nn.Sequential):
    """Conv1d → GroupNorm → Mish."""

    def __init__(self, inner: int, outer: int, kernel: int, groups: int) -> None:
        super().__init__(nn.Conv1d(inner, outer, kernel, padding=kernel // 2), nn.GroupNorm(groups, outer), nn.Mish())


class ResidualBlock(nn.Module):
    """Two conv blocks, the first one scaled and shifted by the condition (FiLM)."""

    def __init__(self, inner: int, outer: int, condition: int, kernel: int, groups: int) -> None:
        super().__init__()
        self.first = ConvBlock(inner, outer, kernel, groups)
        self.second = ConvBlock(outer, outer, kernel, groups)
        self.film = nn.Sequential(nn.Mish(), nn.Linear(condition, 2 * outer))
        self.skip = nn.Conv1d(inner, outer, 1) if inner != outer else nn.Identity()

    def forward(self, x: Float[Tensor, "B C T"], condition: Float[Tensor, "B D"]) -> Float[Tensor, "B C2 T"]:
        scale, shift = self.film(condition).unsqueeze(-1).chunk(2, dim=1)
        return self.second(self.first(x) * scale + shift) + self.skip(x)


@register
@dataclass(frozen=True, kw_only=True)
class UnetSizes:
    """What a ConditionalUnet1d is made with."""

    action_dim: int
    features: int
    widths: tuple[int, ...]
    kernel: int
    step_dim: int
    groups: int


class ConditionalUnet1d(nn.Module):
    """ε_θ(a_k, s, k): the noise in a noisy chunk, given the observation's features."""

    def __init__(
        self, action_dim: int, features: int, widths: tuple[int, ...] = (64, 128, 256), kernel: int = 3,
        step_dim: int = 16, groups: int = 8,
    ) -> None:  # fmt: skip
        super().__init__()
        self.sizes = UnetSizes(
            action_dim=action_dim, features=features, widths=tuple(widths), kernel=kernel, step_dim=step_dim,
            groups=groups,
        )  # fmt: skip
        self.step_embedding = StepEmbedding(step_dim)
        condition = step_dim + features
        channels = [action_dim, *widths]
        self.downs = nn.ModuleList()
        for i, (inner, outer) in enumerate(itertools.pairwise(channels)):
            last = i == len(widths) - 1
            self.downs.append(nn.ModuleList([
                ResidualBlock(inner, outer, condition, kernel, groups),
                ResidualBlock(outer, outer, condition, kernel, groups),
                nn.Identity() if last else nn.Conv1d(outer, outer, 3, stride=2, padding=1),
            ]))  # fmt: skip
        self.middle = nn.ModuleList(
            [ResidualBlock(widths[-1], widths[-1], condition, kernel, groups) for _ in range(2)]
        )
        self.ups = nn.ModuleList()
        for inner, outer in zip(reversed(widths[1:]), reversed(widths[:-1]), strict=True):
            self.ups.append(nn.ModuleList([
                ResidualBlock(2 * inner, outer, condition, kernel, groups),
                ResidualBlock(outer, outer, condition, kernel, groups),
                nn.ConvTranspose1d(outer, outer, 4, stride=2, padding=1),
            ]))  # fmt: skip
        self.out = nn.Sequential(ConvBlock(widths[0], widths[0], kernel, groups), nn.Conv1d(widths[0], action_dim, 1))

    def forward(
        self, noisy: Float[Tensor, "B H A"], k: Float[Tensor, "B"], features: Float[Tensor, "B F"]
    ) -> Float[Tensor, "B H A"]:
        condition = torch.cat([self.step_embedding(k), features], dim=-1)
        x = noisy.transpose(1, 2)
        skips: list[Tensor] = []
        for first, second, shrink in cast("list[Any]", self.downs):
            x = second(first(x, condition), condition)
            skips.append(x)
            x = shrink(x)
        for block in self.middle:
            x = block(x, condition)
        for first, second, grow in cast("list[Any]", self.ups):
            x = second(first(torch.cat([x, skips.pop()], dim=1), condition), condition)
            x = grow(x)
        return self.out(x).transpose(1, 2)
