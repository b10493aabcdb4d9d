"""DP with FCPA: retries learn from the failure, without perturbation (paper, Design of the Retry Algorithm)."""

from __future__ import annotations

from far_app.methods.retry import Ingredients, RetryMethod


def fcpa_only(ingredients: Ingredients) -> RetryMethod:
    return RetryMethod("fcpa", ingredients, adapts=True, perturbs=False)
