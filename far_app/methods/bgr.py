"""DP-BGR, Bellman-guided retrials as the paper adapts them: near a failed state, take the sample that differs most.

The failure memory lies in the policy encoder's feature space (paper, Baselines; Du et al. 2024).
"""

from __future__ import annotations

from far_app.learning.steering import Farthest
from far_app.methods.resampling import Remedy, ResamplingMethod, radius
from far_app.methods.retry import Ingredients


def bgr(ingredients: Ingredients) -> ResamplingMethod:
    return ResamplingMethod("bgr", ingredients, remedy)


def remedy(ingredients: Ingredients) -> Remedy:
    near, samples = radius("bgr", ingredients), ingredients.config.resampling.samples
    return lambda memory, critic: Farthest(memory=memory, radius=near, samples=samples)
