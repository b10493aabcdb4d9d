"""Beyond the paper: retries learn from the failure, and take the best of N of the new policy's samples by Q at every
step."""

from __future__ import annotations

from dataclasses import replace

from far_app.errors import ConfigError
from far_app.learning.policy import DiffusionPolicy
from far_app.learning.steering import BestOf, Steering
from far_app.methods.retry import BASE_VERSION, Ingredients, RetryMethod
from far_app.protocols import Policy


def fcpa_rerank(ingredients: Ingredients) -> RetryMethod:
    if ingredients.critic is None:
        raise ConfigError("method 'fcpa-rerank' needs a critic; train one with `far train critic`, or use nr")
    best = BestOf(critic=ingredients.critic, samples=ingredients.config.resampling.samples)

    def act(network: DiffusionPolicy, version: str, steering: Steering | None = None) -> Policy:
        return ingredients.act(network, version, steering if version == BASE_VERSION else best)

    return RetryMethod("fcpa-rerank", replace(ingredients, act=act), adapts=True, perturbs=False)
