"""DP-BGR, Bellman-guided retrials as the paper adapts them: near a failed state, take the sample that differs most.

The failure memory lies in the policy encoder's feature space (paper, Baselines; Du et al. 2024).
"""

from __future__ import annotations

from far_app.learning.steering import Farthest
from far_app.methods.resampling import Named, Remedy
from far_app.methods.retry import Ingredients


def remedy(ingredients: Ingredients) -> Remedy:
    samples = ingredients.config.resampling.samples
    return lambda memory, critic: Farthest(
        features=memory.features, chunks=memory.chunks, radius=memory.radius, samples=samples
    )


bgr = Named("bgr", remedy)
