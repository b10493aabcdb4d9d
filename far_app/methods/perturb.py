"""DP with perturbation: retries explore, nothing is learnt (paper, Design of the Retry Algorithm)."""

from __future__ import annotations

from far_app.methods.retry import Ingredients, RetryMethod


def perturb(ingredients: Ingredients) -> RetryMethod:
    return RetryMethod("perturb", ingredients, adapts=False, perturbs=True)
