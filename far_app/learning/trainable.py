"""A denoiser seen from its update: run it, get gradients on what it runs with, pull them back to its weights.

`trainable` takes the fast arrangement (fast_unet) where it applies, on CPU, and the plain module everywhere else.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from far_app.learning.cancellation import Cancelled, check, never
from far_app.learning.fast_unet import FastUnet, arrangeable


class Trainable(Protocol):
    parameters: Sequence[Tensor]
    """The weights an update moves."""
    leaves: Sequence[Tensor]
    """What gradients are taken on."""

    def condition(self, features: Float[Tensor, "S F"]) -> Tensor:
        """The observation's part, once a state."""
        ...

    def run(self, noisy: Float[Tensor, "B H A"], k: Int[Tensor, "B"], condition: Tensor) -> Float[Tensor, "B H A"]:
        """ε_θ(a_k, s, k), one row of `condition` each."""
        ...

    def pull_back(self, gradients: Sequence[Tensor]) -> Float[Tensor, "P"]:
        """The flat gradient on `parameters` from the gradients on `leaves`."""
        ...

    def refresh(self) -> None:
        """The weights changed."""
        ...


class PlainDenoiser:
    """A Trainable that is the module itself."""

    def __init__(self, module: nn.Module, cancelled: Cancelled = never) -> None:
        self.module, self._cancelled = module, cancelled
        self.parameters: Sequence[Tensor] = [p for p in module.parameters() if p.requires_grad]
        self.leaves: Sequence[Tensor] = self.parameters

    def condition(self, features: Float[Tensor, "S F"]) -> Tensor:
        return features

    def run(self, noisy: Float[Tensor, "B H A"], k: Int[Tensor, "B"], condition: Tensor) -> Float[Tensor, "B H A"]:
        predicted = self.module(noisy, k, condition)
        if predicted.requires_grad:
            predicted.register_hook(lambda _: check(self._cancelled))
        return predicted

    def pull_back(self, gradients: Sequence[Tensor]) -> Float[Tensor, "P"]:
        return torch.cat([g.flatten() for g in gradients])

    def refresh(self) -> None:
        return None


class Arrange(Protocol):
    def __call__(
        self, module: nn.Module, horizon: int, train: bool = True, cancelled: Cancelled = never
    ) -> Trainable: ...  # fmt: skip


def plain(module: nn.Module, horizon: int, train: bool = True, cancelled: Cancelled = never) -> Trainable:
    """The module as it is written: what `trainable` is measured against and tested against."""
    return PlainDenoiser(module, cancelled)


def trainable(module: nn.Module, horizon: int, train: bool = True, cancelled: Cancelled = never) -> Trainable:
    """The quickest way to run this denoiser on its device; gradients only with `train`, and `cancelled` is looked
    at as they are computed."""
    fast = arrangeable(module, horizon)
    return FastUnet(fast, horizon, train, cancelled) if fast is not None else PlainDenoiser(module, cancelled)
