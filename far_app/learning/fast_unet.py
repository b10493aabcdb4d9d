"""The U-Net's own function, arranged as a few matrix products: same weights, same result, a third of the time on CPU.

A chunk is so short (8, 4, 2 steps) that CPU convolution kernels spend their time on everything but arithmetic. Here a
layer is one product: the taps' inputs side by side (B·T, 3C) times the weights (3C, O); at two steps, where every
output sees every input, (B, 2C) times (2C, 2O). Activations are (B, T, C). FiLM's product is split into a part of the
diffusion step, made once for all steps, and a part of the observation, made once for each state.

    film = W_k mish(embedding(k)) + b + W_s mish(features)

The matrices are linear in the module's weights, so gradients are gathered on the matrices and pulled back to the
weights once. `far_app/learning/unet.py` stays the definition; a test holds the two equal. Called by fcpa, by the
candidates and by the acting policy.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from far_app.learning.diffusion import TRAIN_STEPS
from far_app.learning.unet import ConditionalUnet1d


class _Mish(torch.autograd.Function):
    """x · tanh(softplus(x)) by the logistic function, which has quick vectorised code where exp and tanh do not: with
    q = σ(−x) and r = 2 / (1 + q²) it is x (r − 1), and its slope r (1 + x q² (1 − q) r) − 1."""

    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:  # noqa: ANN001
        opposite = x.neg()
        q = opposite.sigmoid()
        ctx.save_for_backward(x, q)
        return torch.addcdiv(opposite, x, q.square().add_(1), value=2)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> Tensor:  # noqa: ANN001
        x, q = ctx.saved_tensors
        squared = q.square()
        r = (squared + 1).reciprocal_().mul_(2)
        slope = squared.mul_(x).mul_(1 - q).mul_(r).add_(1)
        return slope.mul_(r).sub_(1).mul_(gradient)


def _mish(x: Tensor) -> Tensor:
    opposite = x.neg()
    return torch.addcdiv(opposite, x, opposite.sigmoid().square_().add_(1), value=2)


def mish(x: Tensor) -> Tensor:
    if x.is_cuda or x.numel() < 4096:
        return functional.mish(x)
    return _Mish.apply(x) if x.requires_grad else _mish(x)  # type: ignore[return-value]


class _Taps(torch.autograd.Function):
    """The gradient of `taps` by two additions in place."""

    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:  # noqa: ANN001
        return _taps(x)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> Tensor:  # noqa: ANN001
        before, here, after = gradient.chunk(3, dim=2)
        total = here.clone()
        total[:, :-1] += before[:, 1:]
        total[:, 1:] += after[:, :-1]
        return total


def _taps(x: Tensor) -> Tensor:
    batch, length, channels = x.shape
    out = x.new_empty(batch, length, 3, channels)
    out[:, 1:, 0], out[:, :, 1], out[:, :-1, 2] = x[:, :-1], x, x[:, 1:]
    out[:, 0, 0] = 0.0
    out[:, -1, 2] = 0.0
    return out.flatten(2)


def taps(x: Float[Tensor, "B T C"]) -> Float[Tensor, "B T 3C"]:
    """The inputs before, at and after each step, side by side; zeros past the ends."""
    return _Taps.apply(x) if x.requires_grad else _taps(x)  # type: ignore[return-value]


def tap_matrix(weight: Float[Tensor, "O C 3"]) -> Float[Tensor, "3C O"]:
    return weight.permute(2, 1, 0).reshape(-1, weight.shape[0])


def two_step_matrix(weight: Float[Tensor, "O C 3"]) -> Float[Tensor, "2C 2O"]:
    """[x₀ x₁] → [y₀ y₁] of a kernel-3 convolution over two steps: y₀ = W₁x₀ + W₂x₁, y₁ = W₀x₀ + W₁x₁."""
    w0, w1, w2 = weight.permute(2, 1, 0)
    return torch.cat([torch.cat([w1, w0], dim=1), torch.cat([w2, w1], dim=1)], dim=0)


def upsampling_matrix(weight: Float[Tensor, "C O 4"]) -> Float[Tensor, "3C 2O"]:
    """Taps → both outputs a step makes, of a transposed convolution with kernel 4, stride 2, padding 1:
    y_{2t} = W₃x_{t−1} + W₁x_t and y_{2t+1} = W₂x_t + W₀x_{t+1}."""
    w0, w1, w2, w3 = weight.unbind(2)
    zero = torch.zeros_like(w0)
    return torch.cat([torch.cat([w3, zero], dim=1), torch.cat([w1, w2], dim=1), torch.cat([zero, w0], dim=1)], dim=0)


def fits(module: nn.Module, horizon: int) -> ConditionalUnet1d | None:
    """The module as a U-Net that FastUnet can run: kernel 3, a horizon that halves evenly at every level."""
    if not isinstance(module, ConditionalUnet1d) or horizon % 2 ** (len(module.downs) - 1):
        return None
    u: Any = module
    return module if u.downs[0][0].first[0].weight.shape[2] == 3 else None


def arrangeable(module: nn.Module, horizon: int) -> ConditionalUnet1d | None:
    """One that it runs faster than the module runs itself: on a CPU."""
    fitting = fits(module, horizon)
    return fitting if fitting is not None and next(fitting.parameters()).device.type == "cpu" else None


class FastUnet:
    """A ConditionalUnet1d ready to run many times: `refresh` after its weights changed.

    With `train`, the matrices collect gradients, which `pull_back` turns into the weights' own."""

    def __init__(self, unet: ConditionalUnet1d, horizon: int, train: bool = False) -> None:
        self.unet, self.horizon, self.train = unet, horizon, train
        self.parameters: Sequence[Tensor] = [p for p in unet.parameters() if p.requires_grad]
        self.leaves: Sequence[Tensor] = ()
        self.refresh()

    def refresh(self) -> None:
        """Arrange the module's present weights."""
        with torch.set_grad_enabled(self.train):
            self._arranged = self._arrange()
        self.leaves = [m.detach().requires_grad_(self.train) for m in self._arranged]

    def pull_back(self, gradients: Sequence[Tensor]) -> Float[Tensor, "P"]:
        """The gradient on the module's weights, flat, from the gradients on `leaves`. Once for each refresh."""
        end = _Given.apply(gradients, *self._arranged)
        found = torch.autograd.grad(end, self.parameters, retain_graph=True, materialize_grads=True)  # type: ignore[arg-type]
        return torch.cat([g.flatten() for g in found])

    def _blocks(self) -> list[Any]:
        """Residual blocks in the order they run."""
        u: Any = self.unet  # torch types submodules as plain modules
        return [*(b for d in u.downs for b in d[:2]), *u.middle, *(b for d in u.ups for b in d[:2])]

    def _arrange(self) -> list[Tensor]:
        """Every matrix in the order `__call__` takes them."""
        u: Any = self.unet
        films = [b.film[1] for b in self._blocks()]
        steps = u.step_embedding(torch.arange(TRAIN_STEPS, device=films[0].weight.device))
        weight = torch.cat([f.weight for f in films])
        bias = torch.cat([f.bias for f in films])
        step_dim = steps.shape[1]
        out = [functional.mish(steps) @ weight[:, :step_dim].T + bias, weight[:, step_dim:].T.contiguous()]
        length = self.horizon
        for first, second, shrink in u.downs:
            out += [*_block(first, length), *_block(second, length)]
            if isinstance(shrink, nn.Conv1d):
                out += [tap_matrix(shrink.weight), shrink.bias]
                length //= 2
        for block in u.middle:
            out += _block(block, length)
        for first, second, grow in u.ups:
            out += [*_block(first, length), *_block(second, length)]
            out += [upsampling_matrix(grow.weight), grow.bias.repeat(2)]
            length *= 2
        out += [*_conv(u.out[0], length), u.out[1].weight[:, :, 0].T.contiguous(), u.out[1].bias]
        return out

    def condition(self, features: Float[Tensor, "S F"]) -> Float[Tensor, "S M"]:
        """The observation's part of every block's FiLM."""
        return functional.mish(features) @ self.leaves[1]

    def __call__(
        self, noisy: Float[Tensor, "B H A"], k: Int[Tensor, "B"], features: Float[Tensor, "B F"]
    ) -> Float[Tensor, "B H A"]:
        return self.run(noisy, k, self.condition(features))

    def run(
        self, noisy: Float[Tensor, "B H A"], k: Int[Tensor, "B"], condition: Float[Tensor, "B M"]
    ) -> Float[Tensor, "B H A"]:
        """ε_θ(a_k, s, k), the observation given by its `condition`."""
        return self.filmed(noisy, self.leaves[0][k] + condition)

    def filmed(self, noisy: Float[Tensor, "B H A"], film: Float[Tensor, "B M"]) -> Float[Tensor, "B H A"]:
        """The same, given what scales and shifts every block."""
        u: Any = self.unet
        matrices = iter(self.leaves[2:])
        films = iter(film[:, None].split([2 * b.second[1].num_channels for b in self._blocks()], dim=2))
        x = noisy
        skips: list[Tensor] = []
        for first, second, shrink in u.downs:
            x = _residual(_residual(x, first, matrices, next(films)), second, matrices, next(films))
            skips.append(x)
            if isinstance(shrink, nn.Conv1d):
                x = _affine(taps(x)[:, ::2], next(matrices), next(matrices))
        for block in u.middle:
            x = _residual(x, block, matrices, next(films))
        for first, second, _ in u.ups:
            x = torch.cat([x, skips.pop()], dim=2)
            x = _residual(_residual(x, first, matrices, next(films)), second, matrices, next(films))
            batch, length, _ = x.shape
            x = _affine(taps(x), next(matrices), next(matrices)).reshape(batch, 2 * length, -1)
        x = _convolved(x, u.out[0], matrices)
        return _affine(x, next(matrices), next(matrices))


class _Given(torch.autograd.Function):
    """A scalar whose gradients are given. Handed to autograd itself, as `grad_outputs`, they would first make it import
    a compiler (see FlatAdamW)."""

    @staticmethod
    def forward(ctx, gradients: Sequence[Tensor], *matrices: Tensor) -> Tensor:  # noqa: ANN001
        ctx.gradients = gradients
        return matrices[0].new_zeros(())

    @staticmethod
    def backward(ctx, _: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN001
        return (None, *ctx.gradients)


def _conv(block: Any, length: int) -> list[Tensor]:
    """Matrix and bias of a convolution, then GroupNorm's scale and offset."""
    conv, norm = block[0], block[1]
    two = length == 2
    matrix = two_step_matrix(conv.weight) if two else tap_matrix(conv.weight)
    return [matrix, conv.bias.repeat(2) if two else conv.bias, norm.weight, norm.bias]


def _block(block: Any, length: int) -> list[Tensor]:
    skip = [block.skip.weight[:, :, 0].T.contiguous(), block.skip.bias] if isinstance(block.skip, nn.Conv1d) else []
    return [*_conv(block.first, length), *_conv(block.second, length), *skip]


def _affine(x: Float[Tensor, "B T C"], matrix: Float[Tensor, "C O"], bias: Float[Tensor, "O"]) -> Tensor:
    return torch.addmm(bias, x.reshape(-1, x.shape[2]), matrix).view(x.shape[0], x.shape[1], -1)


def _convolved(x: Float[Tensor, "B T C"], block: Any, matrices: Iterator[Tensor]) -> Tensor:
    """Conv → GroupNorm → Mish."""
    batch, length, _ = x.shape
    matrix, bias, scale, offset = (next(matrices) for _ in range(4))
    if length == 2:
        x = torch.addmm(bias, x.reshape(batch, -1), matrix).view(batch, 2, -1)
    else:
        x = _affine(taps(x), matrix, bias)
    pixels = x.unsqueeze(1).permute(0, 3, 1, 2)  # (B, C, 1, T), channels last: GroupNorm's own layout, no copy
    x = functional.group_norm(pixels, block[1].num_groups, scale, offset, block[1].eps)
    return mish(x.permute(0, 2, 3, 1).squeeze(1))


def _residual(
    x: Float[Tensor, "B T C"], block: Any, matrices: Iterator[Tensor], film: Float[Tensor, "B 1 2O"]
) -> Float[Tensor, "B T O"]:
    scale, shift = film.chunk(2, dim=2)
    h = torch.addcmul(shift, _convolved(x, block.first, matrices), scale)
    h = _convolved(h, block.second, matrices)
    if isinstance(block.skip, nn.Conv1d):
        x = _affine(x, next(matrices), next(matrices))
    return h + x
