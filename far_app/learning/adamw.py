"""AdamW without weight decay on one flat vector, and a step of it that cannot raise the winner's error.

    m ← β₁ m + (1 − β₁) g     v ← β₂ v + (1 − β₂) g²     θ ← θ − lr · m̂ / (√v̂ + ε)

The guarded step uses g = g⁺ + λ g⁻ with the largest λ ∈ [0, 1] for which ⟨∇l⁺, Δθ⟩ ≤ 0, Δθ being the step that Adam
would really take (Diffusion-SDPO, arXiv 2511.03317, scales the loser in the same way but for plain gradient descent,
which says nothing about Adam's element-wise steps). Called by fcpa.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from far_app.errors import PolicyError

BISECTIONS = 6
"""λ is found to within 1/64."""


class FlatAdamW:
    """Holds the moments of one update; the parameters stay in their module."""

    def __init__(
        self, parameters: Sequence[Tensor], lr: float, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-8
    ) -> None:
        self.parameters, self.lr, self.betas, self.eps = parameters, lr, betas, eps
        size = sum(p.numel() for p in parameters)
        self.m, self.v, self.steps = torch.zeros(size), torch.zeros(size), 0

    @torch.no_grad()
    def weights(self) -> Float[Tensor, "P"]:
        return torch.cat([p.flatten() for p in self.parameters])

    @torch.no_grad()
    def set_weights(self, flat: Float[Tensor, "P"]) -> None:
        for p, values in zip(self.parameters, flat.split([p.numel() for p in self.parameters]), strict=True):
            p.copy_(values.reshape(p.shape))

    def proposed(self, gradient: Float[Tensor, "P"]) -> Float[Tensor, "P"]:
        """Δθ that a step with this gradient would take; nothing is changed."""
        b1, b2 = self.betas
        t = self.steps + 1
        m = (b1 * self.m).add_(gradient, alpha=1 - b1)
        scale = (b2 * self.v).addcmul_(gradient, gradient, value=1 - b2).div_(1 - b2**t).sqrt_().add_(self.eps)
        return m.mul_(-self.lr / (1 - b1**t)).div_(scale)

    def step(self, gradient: Float[Tensor, "P"]) -> None:
        """Take the step. Raises PolicyError when the gradient is not finite; nothing is changed then."""
        if not bool(torch.isfinite(gradient).all()):
            raise PolicyError("the gradient of the adaptation is not finite; lower fcpa.lr")
        change = self.proposed(gradient)
        self.m.mul_(self.betas[0]).add_(gradient, alpha=1 - self.betas[0])
        self.v.mul_(self.betas[1]).addcmul_(gradient, gradient, value=1 - self.betas[1])
        self.steps += 1
        self.set_weights(self.weights() + change)


def guarded_step(optimiser: FlatAdamW, g_winner: Float[Tensor, "P"], g_loser: Float[Tensor, "P"]) -> float:
    """One step along g⁺ + λ g⁻ with the largest λ that does not raise l⁺ to first order; returns λ.

    Momentum alone may still raise l⁺ at λ = 0: then it is forgotten and the step follows g⁺."""

    def harmless(share: float) -> bool:
        return float(g_winner @ optimiser.proposed(g_winner + share * g_loser)) <= 0

    if harmless(1.0):
        share = 1.0
    elif harmless(0.0):
        share, too_much = 0.0, 1.0
        for _ in range(BISECTIONS):
            middle = (share + too_much) / 2
            share, too_much = (middle, too_much) if harmless(middle) else (share, middle)
    else:
        share = 0.0
        optimiser.m.zero_()
    optimiser.step(g_winner + share * g_loser)
    return share
