"""Beyond the paper: near a failed state, denoising is pushed away from the chunk that failed there; no weight moves."""

from __future__ import annotations

from far_app.learning.steering import Repelled
from far_app.methods.resampling import Remedy, ResamplingMethod, radius
from far_app.methods.retry import Ingredients


def negative_guidance(ingredients: Ingredients) -> ResamplingMethod:
    return ResamplingMethod("negative-guidance", ingredients, remedy)


def remedy(ingredients: Ingredients) -> Remedy:
    near, strength = radius("negative-guidance", ingredients), ingredients.config.resampling.repulsion
    return lambda memory, critic: Repelled(memory=memory, radius=near, strength=strength)
