"""Beyond the paper: retries take the best of N samples by Q at every step."""

from __future__ import annotations

from far_app.learning.steering import BestOf
from far_app.methods.resampling import Remedy, ResamplingMethod
from far_app.methods.retry import Ingredients


def rerank(ingredients: Ingredients) -> ResamplingMethod:
    return ResamplingMethod("rerank", ingredients, remedy)


def remedy(ingredients: Ingredients) -> Remedy:
    samples = ingredients.config.resampling.samples
    return lambda memory, critic: BestOf(critic=critic, samples=samples)
