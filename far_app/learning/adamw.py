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
PIECE = 2**15
"""Elements worked on at a time, so that a step's dozen operations stay in the cache."""


class FlatAdamW:
    """The weights and moments of one update. The given parameters become views of one flat tensor, `weights`."""

    def __init__(
        self, parameters: Sequence[Tensor], lr: float, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-8
    ) -> None:
        self.lr, self.betas, self.eps = lr, betas, eps
        self.weights = torch.cat([p.detach().flatten() for p in parameters])
        for p, part in zip(parameters, self.weights.split([p.numel() for p in parameters]), strict=True):
            p.data = part.view(p.shape)
        self.m, self.v, self.steps = torch.zeros_like(self.weights), torch.zeros_like(self.weights), 0

    def slope(self, g_winner: Float[Tensor, "P"], g_loser: Float[Tensor, "P"], share: float) -> float:
        """⟨g⁺, Δθ⟩ of the step that g⁺ + share · g⁻ would make; nothing is changed."""
        vectors = (g_winner, g_loser, self.m, self.v)
        total = 0.0
        for winner, loser, m, v in zip(*(x.split(PIECE) for x in vectors), strict=True):
            gradient = torch.add(winner, loser, alpha=share)
            total += float(winner @ self._change(gradient, m * self.betas[0], v * self.betas[1], self.steps + 1))
        return total

    def step(self, gradient: Float[Tensor, "P"]) -> None:
        """Take the step. Raises PolicyError when the gradient is not finite; nothing is changed then."""
        if not bool(torch.isfinite(gradient).all()):
            raise PolicyError("the gradient of the adaptation is not finite; lower fcpa.lr")
        self.steps += 1
        vectors = (self.weights, gradient, self.m, self.v)
        for weights, g, m, v in zip(*(x.split(PIECE) for x in vectors), strict=True):
            weights.add_(self._change(g, m.mul_(self.betas[0]), v.mul_(self.betas[1]), self.steps))

    def _change(self, gradient: Tensor, m: Tensor, v: Tensor, t: int) -> Tensor:
        """Δθ, with the decayed moments m and v brought up to date in place."""
        b1, b2 = self.betas
        m.add_(gradient, alpha=1 - b1)
        v.addcmul_(gradient, gradient, value=1 - b2)
        scale = (v / (1 - b2**t)).sqrt_().add_(self.eps)
        return (m * (-self.lr / (1 - b1**t))).div_(scale)


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
        optimiser.m.zero_()
    optimiser.step(torch.add(g_winner, g_loser, alpha=share))
    return share
