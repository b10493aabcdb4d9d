"""The arranged U-Net's layers, forward and backward by hand. Which matrices each multiplies: fast_unet.

Activations are (B, T, C). `forward` pushes what `back` needs on a stack, `kept` (None: nothing is kept), and `back`
takes it off again, last in, first out; it returns the gradient on the layer's input and sets those on its matrices in
`into`. All matrices are in one list, of which a layer knows the index of its first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from far_app.learning import kernels
from far_app.learning.cancellation import Cancelled, check, never

Kept = list[Any]


@dataclass(frozen=True)
class Affine:
    """x Wᵀ + b, of rows; W is (O, C)."""

    at: int

    def forward(self, rows: Float[Tensor, "N C"], m: Sequence[Tensor], kept: Kept | None) -> Float[Tensor, "N O"]:
        if kept is not None:
            kept.append(rows)
        return torch.addmm(m[self.at + 1], rows, m[self.at].T)

    def back(
        self, g: Float[Tensor, "N O"], m: Sequence[Tensor], kept: Kept, into: list[Tensor | None]
    ) -> Float[Tensor, "N C"]:
        into[self.at], into[self.at + 1] = g.T @ kept.pop(), g.sum(0)
        return g @ m[self.at]


@dataclass(frozen=True)
class Taps:
    """A product over every step (or every `stride`-th) and its neighbours: a convolution of three taps, whose weights
    (O, C, 3) are the matrix as they are."""

    affine: Affine
    stride: int = 1

    def forward(self, x: Float[Tensor, "B T C"], m: Sequence[Tensor], kept: Kept | None) -> Float[Tensor, "B T2 O"]:
        beside = _taps(x, self.stride)
        return self.affine.forward(beside.flatten(0, 1), m, kept).view(*beside.shape[:2], -1)

    def back(
        self, g: Float[Tensor, "B T2 O"], m: Sequence[Tensor], kept: Kept, into: list[Tensor | None]
    ) -> Float[Tensor, "B T C"]:
        batch, length, _ = g.shape
        beside = self.affine.back(g.flatten(0, 1), m, kept, into).view(batch, length, -1, 3)
        to_x = beside.new_empty(batch, length * self.stride, beside.shape[2])
        kernels.taps_back(beside.numpy(), self.stride, to_x.numpy())
        return to_x


@dataclass(frozen=True)
class Whole:
    """A product over all steps at once: [x₀ x₁] Wᵀ."""

    affine: Affine

    def forward(self, x: Float[Tensor, "B T C"], m: Sequence[Tensor], kept: Kept | None) -> Float[Tensor, "B T O"]:
        return self.affine.forward(x.flatten(1), m, kept).view(len(x), x.shape[1], -1)

    def back(
        self, g: Float[Tensor, "B T O"], m: Sequence[Tensor], kept: Kept, into: list[Tensor | None]
    ) -> Float[Tensor, "B T C"]:
        return self.affine.back(g.flatten(1), m, kept, into).view(len(g), g.shape[1], -1)


@dataclass(frozen=True)
class Convolved:
    """Convolution → GroupNorm → Mish, then scaled and shifted by the condition (FiLM) where it has a place there."""

    product: Taps | Whole
    at: int
    """Of GroupNorm's scale; its offset is the next."""
    groups: int
    eps: float
    film: int = -1
    """First column of the condition that is this layer's: scales, then shifts; −1 for none."""

    def forward(
        self, x: Float[Tensor, "B T C"], film: Float[Tensor, "B M"], m: Sequence[Tensor], kept: Kept | None
    ) -> Float[Tensor, "B T O"]:
        x = self.product.forward(x, m, kept)
        scale, offset = m[self.at], m[self.at + 1]
        if not by_kernels(x):
            return self._plainly(x, film, scale, offset)
        y, mean = torch.empty_like(x), x.new_empty(len(x), self.groups)
        rstd = torch.empty_like(mean)
        kernels.norm_mish(
            x.numpy(), scale.numpy(), offset.numpy(), self.eps, film.numpy(), self.film, y.numpy(), mean.numpy(),
            rstd.numpy(),
        )  # fmt: skip
        if kept is not None:
            kept.append((x, mean, rstd))
        return y

    def back(
        self, g: Float[Tensor, "B T O"], film: Float[Tensor, "B M"], m: Sequence[Tensor], kept: Kept,
        into: list[Tensor | None], to_film: Float[Tensor, "B M"],
    ) -> Float[Tensor, "B T C"]:  # fmt: skip
        x, mean, rstd = kept.pop()
        scale, offset = m[self.at], m[self.at + 1]
        to_x, to_scale, to_offset = torch.empty_like(x), torch.empty_like(scale), torch.empty_like(offset)
        kernels.norm_mish_back(
            g.numpy(), x.numpy(), scale.numpy(), offset.numpy(), mean.numpy(), rstd.numpy(), film.numpy(), self.film,
            to_x.numpy(), to_scale.numpy(), to_offset.numpy(), to_film.numpy(),
        )  # fmt: skip
        into[self.at], into[self.at + 1] = to_scale, to_offset
        return self.product.back(to_x, m, kept, into)

    def _plainly(self, x: Tensor, film: Tensor, scale: Tensor, offset: Tensor) -> Tensor:
        pixels = x.unsqueeze(1).permute(0, 3, 1, 2)  # (B, C, 1, T), channels last: GroupNorm's own layout, no copy
        y = functional.mish(functional.group_norm(pixels, self.groups, scale, offset, self.eps))
        y = y.permute(0, 2, 3, 1).squeeze(1)
        if self.film < 0:
            return y
        gain, shift = film[:, None, self.film : self.film + 2 * x.shape[2]].chunk(2, dim=2)
        return torch.addcmul(shift, y, gain)


@dataclass(frozen=True)
class Residual:
    """second(first(x)) + x, or + x Wᵀ where the widths differ; the first is filmed."""

    first: Convolved
    second: Convolved
    skip: Affine | None

    def forward(
        self, x: Float[Tensor, "B T C"], film: Float[Tensor, "B M"], m: Sequence[Tensor], kept: Kept | None
    ) -> Float[Tensor, "B T O"]:
        y = self.second.forward(self.first.forward(x, film, m, kept), film, m, kept)
        if self.skip is None:
            return y.add_(x)
        return y.add_(self.skip.forward(x.flatten(0, 1), m, kept).view_as(y))

    def back(
        self, g: Float[Tensor, "B T O"], film: Float[Tensor, "B M"], m: Sequence[Tensor], kept: Kept,
        into: list[Tensor | None], to_film: Float[Tensor, "B M"],
    ) -> Float[Tensor, "B T C"]:  # fmt: skip
        past = g if self.skip is None else self.skip.back(g.flatten(0, 1), m, kept, into).view(*g.shape[:2], -1)
        through = self.second.back(g, film, m, kept, into, to_film)
        return self.first.back(through, film, m, kept, into, to_film).add_(past)


@dataclass(frozen=True)
class Down:
    first: Residual
    second: Residual
    shrink: Taps | None
    """To half as many steps."""


@dataclass(frozen=True)
class Up:
    first: Residual
    second: Residual
    grow: Taps
    """To twice as many steps: both that come of each, side by side."""


@dataclass(frozen=True)
class Layers:
    """The whole network."""

    downs: Sequence[Down]
    middle: Sequence[Residual]
    ups: Sequence[Up]
    last: Convolved
    out: Affine

    def forward(
        self, noisy: Float[Tensor, "B H A"], film: Float[Tensor, "B M"], m: Sequence[Tensor], kept: Kept | None = None
    ) -> Float[Tensor, "B H A"]:
        x, beside = noisy, []
        for down in self.downs:
            x = down.second.forward(down.first.forward(x, film, m, kept), film, m, kept)
            beside.append(x)
            if down.shrink is not None:
                x = down.shrink.forward(x, m, kept)
        for block in self.middle:
            x = block.forward(x, film, m, kept)
        for up in self.ups:
            x = torch.cat([x, beside.pop()], dim=2)
            x = up.second.forward(up.first.forward(x, film, m, kept), film, m, kept)
            x = up.grow.forward(x, m, kept).view(len(x), 2 * x.shape[1], -1)
        x = self.last.forward(x, film, m, kept)
        return self.out.forward(x.flatten(0, 1), m, kept).view_as(noisy)

    def back(
        self, g: Float[Tensor, "B H A"], film: Float[Tensor, "B M"], m: Sequence[Tensor], kept: Kept,
        cancelled: Cancelled = never,
    ) -> tuple[list[Tensor | None], Float[Tensor, "B M"]]:  # fmt: skip
        """The gradients on the matrices and on the condition, from the output's; `kept` is used up. Looks for
        cancellation between levels, some ms apart."""
        check(cancelled)
        into: list[Tensor | None] = [None] * len(m)
        to_film = torch.empty_like(film)
        g = self.out.back(g.flatten(0, 1), m, kept, into).view(*g.shape[:2], -1)
        g = self.last.back(g, film, m, kept, into, to_film)
        sides: list[Tensor] = []
        for up in reversed(self.ups):
            check(cancelled)
            g = up.grow.back(g.view(len(g), g.shape[1] // 2, -1), m, kept, into)
            g = up.first.back(up.second.back(g, film, m, kept, into, to_film), film, m, kept, into, to_film)
            below, side = g.chunk(2, dim=2)
            g = below.contiguous()
            sides.append(side)
        for block in reversed(self.middle):
            check(cancelled)
            g = block.back(g, film, m, kept, into, to_film)
        for down in reversed(self.downs):
            check(cancelled)
            if down.shrink is not None:
                g = down.shrink.back(g, m, kept, into)
            if sides:
                g.add_(sides.pop())
            g = down.first.back(down.second.back(g, film, m, kept, into, to_film), film, m, kept, into, to_film)
        return into, to_film


def by_kernels(x: Tensor) -> bool:
    """Whether the kernels take it."""
    return x.device.type == "cpu" and x.dtype is torch.float32


def _taps(x: Float[Tensor, "B T C"], stride: int) -> Float[Tensor, "B T2 3C"]:
    batch, length, channels = x.shape
    out = x.new_empty(batch, length // stride, channels, 3)
    if by_kernels(x):
        kernels.taps(x.numpy(), stride, out.numpy())
    else:
        before, after = x[:, stride - 1 : length - 1 : stride], x[:, 1::stride]
        out[:, 0, :, 0] = 0.0
        out[:, 1:, :, 0], out[..., 1] = before, x[:, ::stride]
        out[:, -1, :, 2] = 0.0
        out[:, : after.shape[1], :, 2] = after
    return out.flatten(2)
