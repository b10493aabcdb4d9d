"""Diffusion noise by key: the same (scene, attempt, tick) gives the same noise, for every method, device and run.

So attempt 1 is identical across methods and comparisons are paired. Called by far_app/session/planners.py and by
whoever answers a PlanRequest.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from far_app.seeding import generator


def keyed_noise(key: tuple[int, int, int], horizon: int, action_dim: int) -> Float[np.ndarray, "H A"]:
    """Standard normal noise of one chunk, float32, from (scene, attempt, tick); all at least 0."""
    return generator("diffusion", *key).standard_normal((horizon, action_dim), dtype=np.float32)
