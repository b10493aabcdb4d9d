"""The U-Net's own function, arranged as a few matrix products: same weights, same result, a quarter of the time on CPU.

A chunk is so short (8, 4, 2 steps) that CPU convolution kernels spend their time on everything but arithmetic. Here a
layer is one product: the taps' inputs side by side (B·T, 3C) times the weights (O, 3C); at two steps, where every
output sees every input, (B, 2C) times (2O, 2C); the rest of a layer is one pass over memory (layers.py). FiLM's product
is split into a part of the diffusion step, made once for all steps, and a part of the observation, made once for each
state.

    film = W_k mish(embedding(k)) + b + W_s mish(features)

The matrices are linear in the module's weights, so gradients are gathered on the matrices and pulled back to the
weights once. `far_app/learning/unet.py` stays the definition; a test holds the two equal. Called by fcpa, by the
candidates, by training and by the acting policy.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from far_app.learning import kernels
from far_app.learning.cancellation import Cancelled, never
from far_app.learning.diffusion import TRAIN_STEPS
from far_app.learning.layers import Affine, Convolved, Down, Layers, Residual, Taps, Up, Whole, by_kernels
from far_app.learning.unet import ConditionalUnet1d


class _TwoStep(torch.autograd.Function):
    @staticmethod
    def forward(ctx, weight: Tensor) -> Tensor:  # noqa: ANN001
        ctx.shape = weight.shape
        out = weight.new_empty(2 * weight.shape[0], 2 * weight.shape[1])
        kernels.two_step(weight.detach().contiguous().numpy(), out.numpy())
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient: Tensor) -> Tensor:  # noqa: ANN001
        to_weight = gradient.new_empty(ctx.shape)
        kernels.two_step_back(gradient.contiguous().numpy(), to_weight.numpy())
        return to_weight


def two_step_matrix(weight: Float[Tensor, "O C 3"]) -> Float[Tensor, "2O 2C"]:
    """[x₀ x₁] → [y₀ y₁] of a kernel-3 convolution over two steps: y₀ = W₁x₀ + W₂x₁, y₁ = W₀x₀ + W₁x₁."""
    if by_kernels(weight):
        return _TwoStep.apply(weight)  # type: ignore[return-value]
    w0, w1, w2 = weight.unbind(2)
    return torch.cat([torch.cat([w1, w2], dim=1), torch.cat([w0, w1], dim=1)])


def upsampling_matrix(weight: Float[Tensor, "C O 4"]) -> Float[Tensor, "2O 3C"]:
    """Taps → both outputs a step makes, of a transposed convolution with kernel 4, stride 2, padding 1:
    y_{2t} = W₃x_{t−1} + W₁x_t and y_{2t+1} = W₂x_t + W₀x_{t+1}."""
    w0, w1, w2, w3 = (w.T for w in weight.unbind(2))
    zero = torch.zeros_like(w0)
    return torch.cat([torch.stack([w3, w1, zero], dim=2), torch.stack([zero, w2, w0], dim=2)]).flatten(1)


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

    With `train`, the matrices collect gradients, which `pull_back` turns into the weights' own; `cancelled` is
    looked at between the layers on the way back."""

    def __init__(
        self, unet: ConditionalUnet1d, horizon: int, train: bool = False, cancelled: Cancelled = never
    ) -> None:  # fmt: skip
        self.unet, self.horizon, self.train, self._cancelled = unet, horizon, train, cancelled
        self.parameters: Sequence[Tensor] = [p for p in unet.parameters() if p.requires_grad]
        self.leaves: Sequence[Tensor] = ()
        """FiLM's two matrices, then those of `layers`."""
        self.refresh()

    def refresh(self) -> None:
        """Arrange the module's present weights."""
        with torch.set_grad_enabled(self.train):
            arrangement = _Arrangement(self.unet, self.horizon)
        self.layers = arrangement.layers
        self._arranged = arrangement.matrices
        self._matrices = [m.detach() for m in self._arranged[2:]]
        self.leaves = [m.detach().requires_grad_(self.train) for m in self._arranged]

    def pull_back(self, gradients: Sequence[Tensor]) -> Float[Tensor, "P"]:
        """The gradient on the module's weights, flat, from the gradients on `leaves`. Once for each refresh."""
        end = _Given.apply(gradients, *self._arranged)
        found = torch.autograd.grad(end, self.parameters, retain_graph=True, materialize_grads=True)  # type: ignore[arg-type]
        return torch.cat([g.flatten() for g in found])

    def condition(self, features: Float[Tensor, "S F"]) -> Float[Tensor, "S M"]:
        """The observation's part of every block's FiLM."""
        return functional.mish(features) @ self.leaves[1].T

    def __call__(
        self, noisy: Float[Tensor, "B H A"], k: Int[Tensor, "B"], features: Float[Tensor, "B F"]
    ) -> Float[Tensor, "B H A"]:
        return self.run(noisy, k, self.condition(features))

    def run(
        self, noisy: Float[Tensor, "B H A"], k: Int[Tensor, "B"], condition: Float[Tensor, "B M"]
    ) -> Float[Tensor, "B H A"]:
        """ε_θ(a_k, s, k), the observation given by its `condition`."""
        steps = self.leaves[0].index_select(0, k)  # indexing's gradient is summed in any order by several threads
        return self.filmed(noisy, steps + condition)

    def filmed(self, noisy: Float[Tensor, "B H A"], film: Float[Tensor, "B M"]) -> Float[Tensor, "B H A"]:
        """The same, given what scales and shifts every block. No gradient comes back on the noisy chunk."""
        if self.train and torch.is_grad_enabled():
            return _Pass.apply(  # type: ignore[return-value]
                self.layers, self._matrices, self._cancelled, noisy, film, *self.leaves[2:]
            )  # fmt: skip
        return self.layers.forward(noisy.contiguous(), film, self._matrices)


class _Pass(torch.autograd.Function):
    """The layers, which know their own way back, as autograd sees them: one operation of the leaves."""

    @staticmethod
    def forward(
        ctx,
        layers: Layers,
        matrices: Sequence[Tensor],
        cancelled: Cancelled,
        noisy: Tensor,
        film: Tensor,
        *leaves: Tensor,  # noqa: ANN001
    ) -> Tensor:
        ctx.layers, ctx.cancelled, ctx.film, ctx.matrices, ctx.kept = layers, cancelled, film.detach(), matrices, []
        return layers.forward(noisy.detach().contiguous(), ctx.film, ctx.matrices, ctx.kept)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient: Tensor) -> tuple[Any, ...]:  # noqa: ANN001
        into, to_film = ctx.layers.back(gradient.contiguous(), ctx.film, ctx.matrices, ctx.kept, ctx.cancelled)
        return None, None, None, None, to_film, *into


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


class _Arrangement:
    """One walk over the module: FiLM's two matrices, then the layers and what they multiply, in the order they run."""

    def __init__(self, unet: ConditionalUnet1d, horizon: int) -> None:
        u: Any = unet  # torch types submodules as plain modules
        self.films: list[nn.Linear] = []
        self.column = 0
        self.matrices: list[Tensor] = []
        self.length = horizon
        downs = [self._down(*level) for level in u.downs]
        middle = [self._residual(block) for block in u.middle]
        ups = [self._up(*level) for level in u.ups]
        last = self._convolved(u.out[0])
        out = self._affine(u.out[1].weight[:, :, 0], u.out[1].bias)
        self.layers = Layers(downs, middle, ups, last, out)
        self.matrices = [*self._film(u.step_embedding), *self.matrices]

    def _film(self, embed: nn.Module) -> tuple[Tensor, Tensor]:
        """(W_k mish(embedding(k)) + b of every step, W_s)."""
        weight = torch.cat([f.weight for f in self.films])
        bias = torch.cat([f.bias for f in self.films])
        steps = embed(torch.arange(TRAIN_STEPS, device=weight.device))
        known = steps.shape[1]
        return functional.mish(steps) @ weight[:, :known].T + bias, weight[:, known:]

    def _down(self, first: Any, second: Any, shrink: Any) -> Down:
        blocks = self._residual(first), self._residual(second)
        if isinstance(shrink, nn.Identity):
            return Down(*blocks, None)
        self.length //= 2
        return Down(*blocks, Taps(self._affine(shrink.weight.flatten(1), shrink.bias), stride=2))

    def _up(self, first: Any, second: Any, grow: Any) -> Up:
        blocks = self._residual(first), self._residual(second)
        self.length *= 2
        return Up(*blocks, Taps(self._affine(upsampling_matrix(grow.weight), grow.bias.repeat(2))))

    def _residual(self, block: Any) -> Residual:
        self.films.append(block.film[1])
        first = self._convolved(block.first, film=self.column)
        self.column += block.film[1].out_features
        second = self._convolved(block.second)
        if isinstance(block.skip, nn.Identity):
            return Residual(first, second, None)
        return Residual(first, second, self._affine(block.skip.weight[:, :, 0], block.skip.bias))

    def _convolved(self, block: Any, film: int = -1) -> Convolved:
        conv, norm = block[0], block[1]
        if self.length == 2:
            product: Taps | Whole = Whole(self._affine(two_step_matrix(conv.weight), conv.bias.repeat(2)))
        else:
            product = Taps(self._affine(conv.weight.flatten(1), conv.bias))
        at = len(self.matrices)
        self.matrices += [norm.weight, norm.bias]
        return Convolved(product, at, norm.num_groups, norm.eps, film)

    def _affine(self, matrix: Tensor, bias: Tensor) -> Affine:
        self.matrices += [matrix, bias]
        return Affine(len(self.matrices) - 2)
