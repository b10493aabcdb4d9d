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

BISECTIONS = 5
"""λ is found to within 1/32."""
PIECE = 2**16
"""Elements gone through together, so that what several operations touch stays in the cache."""


class FlatAdamW:
    """AdamW without weight decay over one flat tensor, `weights`, of which the given parameters become views.

    Not torch.optim's: the first optimiser that a process makes imports a compiler, for a second and a half in which it
    holds the interpreter a tenth of a second at a time, and the control loop waits."""

    def __init__(
        self, parameters: Sequence[Tensor], lr: float, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-8
    ) -> None:
        self.weights = torch.cat([p.detach().flatten() for p in parameters])
        for p, part in zip(parameters, self.weights.split([p.numel() for p in parameters]), strict=True):
            p.data = part.view(p.shape)
        self.lr, self.betas, self.eps = lr, betas, eps
        self.m, self.v = torch.zeros_like(self.weights), torch.zeros_like(self.weights)
        self.steps = 0

    def forget_momentum(self) -> None:
        self.m.zero_()

    def step(self, gradient: Float[Tensor, "P"]) -> None:
        """Take the step. Raises PolicyError when the gradient is not finite; nothing is changed then."""
        if not bool(torch.isfinite(gradient.sum())):
            raise PolicyError("the gradient of the adaptation is not finite; lower fcpa.lr")
        self.steps += 1
        b1, b2 = self.betas
        rate, grown = self.lr / (1 - b1**self.steps), 1 - b2**self.steps
        for weights, m, v, g in zip(*(x.split(PIECE) for x in (self.weights, self.m, self.v, gradient)), strict=True):
            m.lerp_(g, 1 - b1)
            v.mul_(b2).addcmul_(g, g, value=1 - b2)
            weights.addcdiv_(m, (v / grown).sqrt_().add_(self.eps), value=-rate)

    def slope(self, g_winner: Float[Tensor, "P"], g_loser: Float[Tensor, "P"], share: float) -> float:
        """⟨g⁺, Δθ⟩ of the step that g⁺ + share · g⁻ would make; nothing is changed."""
        b1, b2 = self.betas
        grown = 1 - b2 ** (self.steps + 1)
        total = 0.0
        for winner, loser, m_, v_ in zip(*(x.split(PIECE) for x in (g_winner, g_loser, self.m, self.v)), strict=True):
            gradient = torch.add(winner, loser, alpha=share)
            change = torch.lerp(gradient, m_, b1)
            scale = (v_ * (b2 / grown)).addcmul_(gradient, gradient, value=(1 - b2) / grown).sqrt_().add_(self.eps)
            total += float(winner @ change.div_(scale))
        return -self.lr / (1 - b1 ** (self.steps + 1)) * total


def guarded_step(optimiser: FlatAdamW, g_winner: Float[Tensor, "P"], g_loser: Float[Tensor, "P"]) -> float:
    """One step along g⁺ + λ g⁻ with the largest λ that does not raise l⁺ to first order; returns λ.

    Momentum alone may still raise l⁺ at λ = 0: then it is forgotten and the step follows g⁺."""

    def harmless(share: float) -> bool:
        return optimiser.slope(g_winner, g_loser, share) <= 0

    if harmless(1.0):
        share = 1.0
    elif harmless(0.0):
        share, too_much = 0.0, 1.0
        for _ in range(BISECTIONS):
            middle = (share + too_much) / 2
            share, too_much = (middle, too_much) if harmless(middle) else (share, middle)
    else:
        share = 0.0
        optimiser.forget_momentum()
    optimiser.step(torch.add(g_winner, g_loser, alpha=share))
    return share
