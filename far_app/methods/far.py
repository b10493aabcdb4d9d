"""DP-FAR: retries learn from the failure and explore (paper, Algorithm 1)."""

from __future__ import annotations

from far_app.methods.retry import Ingredients, RetryMethod


def far(ingredients: Ingredients) -> RetryMethod:
    return RetryMethod("far", ingredients, adapts=True, perturbs=True)
