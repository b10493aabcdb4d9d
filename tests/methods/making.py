"""A method with small networks, and what tests ask of it."""

import numpy as np
import torch

from far_app.config import FCPAConfig, PairsConfig, RetryConfig
from far_app.learning.policy import DiffusionPolicy
from far_app.learning.preference import Demonstrations
from far_app.learning.runtime import ActingPolicy
from far_app.methods import Ingredients, method
from far_app.methods.evidence import history
from far_app.protocols import Method
from tests.learning.small import small_attempt, small_critic, small_policy

QUICK = RetryConfig(
    pairs=PairsConfig(candidates=8, positives=3, d_max=50.0), fcpa=FCPAConfig(steps=3, lr=1e-3, draws=2)
)


def made(name: str, config: RetryConfig = QUICK, network: DiffusionPolicy | None = None):
    network = network or small_policy()
    critic = small_critic(network)
    return method(name, Ingredients(
        network=network, critic=critic, config=config, demonstrations=demonstrations(network),
        act=lambda network, version, steering=None: ActingPolicy(network, version, critic, "torch", steering),
    ))  # fmt: skip


def demonstrations(network: DiffusionPolicy) -> Demonstrations:
    features = network.encode([history(small_attempt(), t, 2) for t in range(0, 40, 4)])
    return Demonstrations(features=features, chunks=torch.zeros(len(features), 8, 7))


def plan(m: Method, seed: int = 0, tick: int = 1) -> np.ndarray:
    noise = np.random.default_rng(seed).standard_normal((1, 8, 7)).astype(np.float32)
    return m.policy.plan([history(small_attempt(), tick, 2)], [tick], noise)[0].actions


def adapt(m: Method, attempt=None, cancelled=lambda: False):
    return m.adapt(attempt or small_attempt(), cancelled, lambda step: None)
