"""DP and DP-NR: the same policy again, nothing learnt, nothing perturbed (paper, Baselines)."""

from __future__ import annotations

from far_app.methods.retry import Ingredients, RetryMethod


def naive(ingredients: Ingredients) -> RetryMethod:
    return RetryMethod("nr", ingredients, adapts=False, perturbs=False)


def single(ingredients: Ingredients) -> RetryMethod:
    """The base policy alone: one attempt a trial."""
    return RetryMethod("dp", ingredients, adapts=False, perturbs=False)
