"""One gradient step of behaviour cloning: `PlainStep` to be read, `FastStep` to be run, the same; `LowStep` less exact.

    loss = E ‖ε − ε_θ(a_k, s, k)‖² [+ localisation]      θ ← AdamW      θ_EMA ← θ_EMA + (1 − decay)(θ − θ_EMA)

The fast form encodes a frame that several histories share once (segments), runs the denoiser as a few matrix products
(fast_unet, on CPU), and updates all weights in one call each (fused AdamW, one EMA over all). On a GPU activations are
bfloat16, on a CPU those of the camera networks are with `LowStep`; weights, gradients, moments, the loss and the place
where a feature map fires stay float32. Called by train_policy and `far bench train`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from far_app.learning.diffusion import TRAIN_STEPS, add_noise
from far_app.learning.policy import DiffusionPolicy
from far_app.learning.segments import Segments, history_features, segment_features
from far_app.learning.trainable import PlainDenoiser, Trainable, trainable

BETAS = (0.95, 0.999)


def denoising_loss(
    denoiser: Trainable,
    features: Tensor,
    chunks: Tensor,
    generator: torch.Generator,
    draws: int,
    weights: Float[Tensor, "B"] | None = None,
) -> Tensor:
    """E w ‖ε − ε_θ(a_k, s, k)‖², averaged over entries; w is 1 without weights."""
    chunks, condition = chunks.repeat(draws, 1, 1), denoiser.condition(features).repeat(draws, 1)
    k = torch.randint(0, TRAIN_STEPS, (len(chunks),), generator=generator).to(chunks.device)
    noise = torch.randn(chunks.shape, generator=generator).to(chunks.device)
    squared = (denoiser.run(add_noise(chunks, noise, k), k, condition).float() - noise).square()
    return squared.mean() if weights is None else (squared.mean(dim=(1, 2)) * weights.repeat(draws)).mean()


def backward(loss: Tensor, denoiser: Trainable) -> None:
    """Gradients of the loss on the encoder's and the denoiser's own weights."""
    loss.backward()
    flat = denoiser.pull_back([torch.zeros_like(m) if m.grad is None else m.grad for m in denoiser.leaves])
    for parameter, gradient in zip(
        denoiser.parameters, flat.split([p.numel() for p in denoiser.parameters]), strict=True
    ):
        parameter.grad = gradient.view_as(parameter)


class PlainStep:
    """As one would write it down."""

    def __init__(
        self, policy: DiffusionPolicy, ema: DiffusionPolicy, locator: nn.Module | None, *, lr: float,
        weight_decay: float, draws: int, localise: float,
    ) -> None:  # fmt: skip
        """`locator`: from features to object offsets, with `localise` as the weight of its loss."""
        self.policy, self.ema, self.locator = policy, ema, locator
        self.draws, self.localise = draws, localise
        self.device = policy.normalizer.low.device
        learnt = [*(p for p in policy.parameters() if p.requires_grad), *(locator.parameters() if locator else ())]
        self.optimizer = self._optimizer(learnt, lr=lr, betas=BETAS, weight_decay=weight_decay)
        self.denoiser = self._denoiser()

    def loss(self, drawn: Segments, generator: torch.Generator, weights: Float[Tensor, "B"] | None) -> Tensor:
        """Of a batch; (k, ε) come from the generator, the same in both forms."""
        images = {c: v.to(self.device, non_blocking=True) for c, v in drawn.images.items()}
        with self._precision():
            features = self._features(images, drawn.states.to(self.device))
            self.denoiser.refresh()
            chunks = drawn.chunks.flatten(0, 1).to(self.device)
            loss = denoising_loss(self.denoiser, features, chunks, generator, self.draws, weights)
            if self.locator is not None and drawn.offsets is not None:
                located = (self.locator(features) - drawn.offsets.flatten(0, 1).to(self.device)).square().mean()
                loss = loss + self.localise * located
        return loss

    def update(self, loss: Tensor, lr: float, decay: float) -> None:
        """Move the weights along the loss's gradient and their running mean after them."""
        for group in self.optimizer.param_groups:
            group["lr"] = lr
        self.optimizer.zero_grad(set_to_none=True)
        backward(loss, self.denoiser)
        self.optimizer.step()
        with torch.no_grad():
            self._follow(1.0 - decay)
            for slow, fast in zip(self.ema.buffers(), self.policy.buffers(), strict=True):
                slow.copy_(fast)

    def _optimizer(self, learnt: Iterable[Tensor], **settings: Any) -> torch.optim.AdamW:
        return torch.optim.AdamW(learnt, foreach=False, **settings)

    def _denoiser(self) -> Trainable:
        return PlainDenoiser(self.policy.denoiser)

    def _precision(self) -> contextlib.AbstractContextManager[Any]:
        return contextlib.nullcontext()

    def _features(self, images: dict[str, Tensor], states: Tensor) -> Float[Tensor, "B F"]:
        return history_features(self.policy, images, states)

    def _follow(self, share: float) -> None:
        for slow, fast in zip(self.ema.parameters(), self.policy.parameters(), strict=True):
            slow.lerp_(fast, share)


class FastStep(PlainStep):
    """The same in a fraction of the time."""

    def _optimizer(self, learnt: Iterable[Tensor], **settings: Any) -> torch.optim.AdamW:
        return torch.optim.AdamW(learnt, fused=True, **settings)

    def _denoiser(self) -> Trainable:
        return trainable(self.policy.denoiser, self.policy.config.horizon)

    def _precision(self) -> contextlib.AbstractContextManager[Any]:
        if self.device.type == "cpu":  # float32 is as fast there, and repeatable to the bit
            return contextlib.nullcontext()
        return torch.autocast(self.device.type, torch.bfloat16)

    def _features(self, images: dict[str, Tensor], states: Tensor) -> Float[Tensor, "B F"]:
        return segment_features(self.policy, images, states)

    def _follow(self, share: float) -> None:
        slow: list[Tensor] = [*self.ema.parameters()]
        fast: list[Tensor] = [*self.policy.parameters()]
        torch._foreach_lerp_(slow, fast, share)  # pyright: ignore[reportPrivateImportUsage] - it has no public name


class LowStep(FastStep):
    """Camera networks in bfloat16 on a CPU too: quicker where the processor multiplies it itself (AMX, AVX-512 BF16),
    and the same to the bit on such processors alone."""

    def _features(self, images: dict[str, Tensor], states: Tensor) -> Float[Tensor, "B F"]:
        with torch.autocast(self.device.type, torch.bfloat16):
            return super()._features(images, states).float()
