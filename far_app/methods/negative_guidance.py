"""Beyond the paper: near a failed state, denoising is pushed away from the chunk that failed there; no weight moves."""

from __future__ import annotations

from far_app.learning.steering import Repelled
from far_app.methods.resampling import Named, Remedy
from far_app.methods.retry import Ingredients


def remedy(ingredients: Ingredients) -> Remedy:
    strength = ingredients.config.resampling.repulsion
    return lambda memory, critic: Repelled(
        features=memory.features, chunks=memory.chunks, radius=memory.radius, strength=strength
    )


negative_guidance = Named("negative-guidance", remedy)
