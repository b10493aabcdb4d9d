"""Beyond the paper: retries take the best of N samples by Q at every step."""

from __future__ import annotations

from far_app.learning.steering import BestOf
from far_app.methods.resampling import Named, Remedy
from far_app.methods.retry import Ingredients


def remedy(ingredients: Ingredients) -> Remedy:
    samples = ingredients.config.resampling.samples
    return lambda memory, critic: BestOf(critic=critic, samples=samples)


rerank = Named("rerank", remedy)
