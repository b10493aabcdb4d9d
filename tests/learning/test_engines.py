"""OpenVINO gives what torch gives, on the weights it was made with, whatever was compiled before."""

import copy

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from far_app.errors import ConfigError
from far_app.learning import engines, openvino_unet
from far_app.learning.fast_unet import FastUnet
from far_app.learning.runtime import ActingPolicy
from tests.learning.small import small_attempt, small_policy

needs_openvino = pytest.mark.skipif(not openvino_unet.available(), reason="pip install openvino")


def same(policy, other=None, batch: int = 1, seed: int = 0) -> bool:
    """Whether both engines denoise alike; the first of `policy`, the second of `other`."""
    torch.manual_seed(seed)
    noisy, k = torch.randn(batch, 8, 7), torch.randint(0, 100, (batch,))
    features = torch.randn(batch, policy.feature_dim)
    found = []
    for network, engine in ((policy, "torch"), (other or policy, "openvino")):
        run = engines.runner(network.denoiser, 8, engine)
        with torch.inference_mode():
            found.append(run.run(noisy, k, run.condition(features)))
    return bool(torch.allclose(*found, atol=1e-4))


@needs_openvino
@settings(max_examples=10, deadline=None)
@given(batch=st.integers(1, 10), seed=st.integers(0, 1000))
def test_both_engines_denoise_alike(batch, seed):
    assert same(small_policy(seed % 3), batch=batch, seed=seed)


@needs_openvino
def test_adapted_weights_are_the_ones_that_act():
    """The graph is shared by all weights of an architecture; each runner reads its own."""
    base = small_policy()
    adapted = copy.deepcopy(base)
    with torch.no_grad():
        for parameter in adapted.denoiser.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    before = engines.runner(base.denoiser, 8, "openvino")
    assert same(adapted) and same(base)
    assert not same(base, adapted)
    arguments = (
        torch.zeros(1, 8, 7),
        torch.zeros(1, dtype=torch.long),
        before.condition(torch.zeros(1, base.feature_dim)),
    )
    assert torch.allclose(before.run(*arguments), FastUnet(base.denoiser, 8).run(*arguments), atol=1e-4)


@needs_openvino
def test_the_acting_policy_plans_the_same_chunk_under_either_engine():
    policy, attempt = small_policy(), small_attempt()
    history = (attempt.steps[0].observation, attempt.steps[1].observation)
    noise = np.random.default_rng(0).standard_normal((1, 8, 7)).astype(np.float32)
    (a,), (b,) = (ActingPolicy(policy, "v", engine=e).plan([history], [1], noise) for e in ("torch", "openvino"))
    assert np.allclose(a.actions, b.actions, atol=1e-4)


def test_without_openvino_auto_is_torch_and_asking_for_it_says_what_to_do(monkeypatch):
    monkeypatch.setattr(openvino_unet, "available", lambda: False)
    assert isinstance(engines.runner(small_policy().denoiser, 8), FastUnet)
    assert engines.chosen() == "torch"
    with pytest.raises(ConfigError, match="pip install openvino"):
        engines.runner(small_policy().denoiser, 8, "openvino")
