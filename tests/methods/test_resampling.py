"""bgr, rerank and negative-guidance: same weights, other chunks, and only after a failure; fcpa-rerank: both."""

import numpy as np
import pytest
import torch

from far_app.config import ResamplingConfig, RetryConfig
from far_app.errors import ConfigError
from far_app.learning.preference import Demonstrations
from far_app.learning.steering import more_noise
from far_app.methods import Ingredients, method
from far_app.methods.evidence import history
from far_app.methods.resampling import radius
from tests.learning.small import small_attempt, small_critic, small_policy
from tests.methods.test_methods import QUICK, adapt, made, plan


def plans(m, tick: int) -> np.ndarray:
    """Under several noises: the first sample may happen to be the one that is picked."""
    return np.stack([plan(m, seed, tick) for seed in range(6)])


NAMES = ["bgr", "rerank", "negative-guidance"]


@pytest.mark.parametrize("name", NAMES)
def test_a_failure_changes_how_the_retry_acts_and_the_next_trial_forgets_it(name):
    to_blame = adapt(made(name)).flagged[0]
    m = made(name)
    m.begin(5)
    before = plans(m, to_blame)
    adaptation = adapt(m)
    assert adaptation.status == "adapted" and adaptation.flagged and not adaptation.history
    assert m.policy.version == adaptation.version == f"base+{name}1"
    assert not np.array_equal(plans(m, to_blame), before)
    adapt(m, small_attempt(index=2))
    assert m.policy.version == f"base+{name}2"
    m.begin(6)
    assert m.policy.version == "base"
    assert np.array_equal(plans(m, to_blame), before)


@pytest.mark.parametrize("name", NAMES)
def test_a_cancelled_lesson_changes_nothing(name):
    m = made(name)
    m.begin(5)
    assert adapt(m, cancelled=lambda: True).status == "cancelled"
    assert m.policy.version == "base"


def test_the_radius_is_a_percentile_of_the_demonstrations_distances():
    network = small_policy()
    features = torch.zeros(4, network.feature_dim)
    features[:, 0] = torch.tensor([0.0, 1.0, 3.0, 7.0])  # nearest others: 1, 1, 2, 4
    ingredients = Ingredients(
        network=network, critic=None, act=None, config=RetryConfig(resampling=ResamplingConfig(radius_percentile=50)),
        demonstrations=Demonstrations(features=features, chunks=torch.zeros(4, 8, 7)),
    )  # fmt: skip
    assert radius("bgr", ingredients) == pytest.approx(1.5)


@pytest.mark.parametrize("name", ["bgr", "negative-guidance"])
def test_without_demonstrations_there_is_no_measure_of_nearness(name):
    network = small_policy()
    ingredients = Ingredients(network=network, critic=small_critic(network), act=lambda *given: None)
    with pytest.raises(ConfigError, match=f"{name}.*demonstrations beside the critic"):
        method(name, ingredients)


@pytest.mark.parametrize("name", ["rerank", "fcpa-rerank"])
def test_without_a_critic_it_says_so(name):
    network = small_policy()
    with pytest.raises(ConfigError, match="needs a critic"):
        method(name, Ingredients(network=network, critic=None, act=lambda *a: None))


def test_after_a_lesson_the_new_policys_best_sample_acts():
    """fcpa-rerank: the weights are those that fcpa learns, the chunk is the one of N with the highest Q."""
    m, plain = made("fcpa-rerank"), made("fcpa")
    for learner in (m, plain):
        learner.begin(5)
        assert adapt(learner).status == "adapted"
    assert m.policy.version == plain.policy.version == "base+a1"
    history_, noise = history(small_attempt(), 3, 2), np.random.default_rng(1).standard_normal((1, 8, 7)).astype("f4")
    (chunk,) = m.policy.plan([history_], [3], noise)
    samples = torch.from_numpy(more_noise(noise[0], QUICK.resampling.samples))
    features = plain.acting.encode([history_]).expand(len(samples), -1)
    chunks = plain.acting.sample(features, samples)
    best = int(small_critic(plain.acting).q(features, chunks).argmax())
    assert np.allclose(chunk.actions, chunks[best].numpy(), atol=1e-5)
    assert len(chunk.candidates) == QUICK.resampling.samples
    m.begin(6)
    (chunk,) = m.policy.plan([history_], [3], noise)
    assert m.policy.version == "base" and chunk.candidates is None, "the first attempt is the base policy's"
