"""DDPM training noise and DDIM sampling: 100 steps, squared-cosine schedule, ε-prediction, x₀ clipped to [−1, 1].

a_k = √ᾱ_k a_0 + √(1 − ᾱ_k) ε                                   (Ho et al. 2020)
a_{k'} = √ᾱ_{k'} â_0 + √(1 − ᾱ_{k'}) ε̂                          (Song et al. 2021, η = 0)
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

Denoiser = Callable[[Tensor, Tensor, Tensor], Tensor]
"""ε_θ(a_k (B, H, A), k (B,), features (B, F)) → (B, H, A)."""

TRAIN_STEPS = 100


def cosine_alpha_bars(steps: int = TRAIN_STEPS) -> Float[Tensor, "K"]:
    """ᾱ_k of the squared-cosine schedule (Nichol and Dhariwal 2021), β at most 0.999."""

    def level(u: float) -> float:
        return math.cos((u + 0.008) / 1.008 * math.pi / 2) ** 2

    betas = [min(1.0 - level((i + 1) / steps) / level(i / steps), 0.999) for i in range(steps)]
    return torch.cumprod(1.0 - torch.tensor(betas, dtype=torch.float64), dim=0).float()


ALPHA_BARS = cosine_alpha_bars()


def add_noise(
    chunk: Float[Tensor, "B H A"], noise: Float[Tensor, "B H A"], k: Int[Tensor, "B"]
) -> Float[Tensor, "B H A"]:
    """a_k from a_0 and ε."""
    alpha_bar = ALPHA_BARS.to(chunk.device)[k].view(-1, *[1] * (chunk.ndim - 1))
    return alpha_bar.sqrt() * chunk + (1.0 - alpha_bar).sqrt() * noise


def ddim_steps(count: int) -> list[int]:
    """The diffusion steps a DDIM chain of `count` visits, from the noisiest down ("leading" spacing, offset 0)."""
    stride = TRAIN_STEPS // count
    return [i * stride for i in reversed(range(count))]


def ddim_coefficients(count: int) -> list[tuple[int, float, float, float, float]]:
    """For each visited step: k, √ᾱ_k, √(1−ᾱ_k), √ᾱ_{k'}, √(1−ᾱ_{k'}), with ᾱ = 1 past the end."""
    steps = ddim_steps(count)
    bars = [float(ALPHA_BARS[k]) for k in steps] + [1.0]
    return [
        (k, math.sqrt(a), math.sqrt(1 - a), math.sqrt(b), math.sqrt(1 - b))
        for k, a, b in zip(steps, bars[:-1], bars[1:], strict=True)
    ]


def ddim_sample(
    denoiser: Denoiser,
    features: Float[Tensor, "B F"],
    noise: Float[Tensor, "B H A"],
    count: int,
    push: Callable[[Float[Tensor, "B H A"]], Float[Tensor, "B H A"]] | None = None,
) -> Float[Tensor, "B H A"]:
    """Chunks denoised from the given noise in `count` deterministic steps; `push` may move each step's estimate of the
    clean chunks."""
    x = noise
    for k, root_a, root_na, root_b, root_nb in ddim_coefficients(count):
        steps = torch.full((x.shape[0],), k, device=x.device, dtype=torch.long)
        epsilon = denoiser(x, steps, features)
        clean = ((x - root_na * epsilon) / root_a).clamp(-1.0, 1.0)
        if push is not None:
            clean = push(clean).clamp(-1.0, 1.0)
        epsilon = (x - root_a * clean) / root_na
        x = root_b * clean + root_nb * epsilon
    return x
