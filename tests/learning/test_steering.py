"""Acting otherwise with the same weights: what is picked, what is pushed, and when."""

import dataclasses

import numpy as np
import pytest
import torch

from far_app.learning.runtime import ActingPolicy
from far_app.learning.steering import BestOf, Farthest, Memory, Repelled, more_noise
from tests.learning.small import small_attempt, small_critic, small_policy

FAILED = torch.zeros(1, 2, 7)
STATE = torch.ones(3)


ONE = Memory(features=torch.ones(1, 3), chunks=FAILED)


def near(kind, **settings):
    return kind(memory=ONE, radius=0.5, **settings)


def test_a_state_counts_when_it_is_near_a_failed_one():
    steering = near(Farthest, samples=3)
    assert steering.applies(STATE + 0.1)
    assert not steering.applies(STATE + 1.0)
    assert not dataclasses.replace(steering, memory=Memory.empty(3, 2)).applies(STATE)


def test_a_memory_grows_and_finds_the_nearest():
    grown = ONE.grown(torch.full((1, 3), 4.0), FAILED + 1)
    assert len(grown) == 2 and len(ONE) == 1
    assert grown.nearest(torch.full((3,), 3.5)) == (1, pytest.approx(0.75**0.5))


def test_the_farthest_sample_by_the_arms_entries_acts():
    chunks = torch.zeros(3, 2, 7)
    chunks[1, :, 0] = 0.5
    chunks[2, :, 6] = 1.0  # the gripper alone is no difference
    assert near(Farthest, samples=3).pick(STATE, STATE, chunks) == 1


def test_repulsion_moves_away_by_its_strength_and_leaves_the_gripper():
    clean = torch.zeros(1, 2, 7)
    clean[0, 0, 1], clean[0, 1, 6] = 0.2, 0.7
    pushed = near(Repelled, strength=0.3).push(STATE, clean)
    assert torch.allclose(pushed[0, 0, 1], torch.tensor(0.5))
    assert torch.equal(pushed[..., 6], clean[..., 6])
    assert torch.isfinite(near(Repelled, strength=0.3).push(STATE, FAILED.clone())).all(), "even at the chunk itself"


def test_the_best_of_n_by_q_acts():
    policy = small_policy()
    critic = small_critic(policy)
    shown, chunks = torch.randn(policy.feature_dim), torch.randn(5, 8, 7)
    scores = [critic.q(shown[None], c[None]).item() for c in chunks]
    assert BestOf(critic=critic, samples=5).pick(shown, shown, chunks) == int(np.argmax(scores))


def test_more_noise_begins_with_the_given_one_and_repeats():
    noise = np.random.default_rng(0).standard_normal((8, 7)).astype(np.float32)
    one, two = more_noise(noise, 4), more_noise(noise.copy(), 4)
    assert np.array_equal(one, two) and np.array_equal(one[0], noise)
    assert not np.array_equal(one[1], one[2]) and one.shape == (4, 8, 7)
    assert not np.array_equal(more_noise(noise + 1, 4)[1], one[1])


def test_the_acting_policy_shows_what_it_considered_and_acts_on_the_pick():
    policy, attempt = small_policy(), small_attempt()
    critic = small_critic(policy)
    history = (attempt.steps[0].observation, attempt.steps[1].observation)
    noise = np.random.default_rng(0).standard_normal((1, 8, 7)).astype(np.float32)
    (plain,) = ActingPolicy(policy, "v", critic, "torch").plan([history], [1], noise)
    (best,) = ActingPolicy(policy, "v", critic, "torch", BestOf(critic=critic, samples=4)).plan([history], [1], noise)
    assert plain.candidates is None and best.candidates.shape == (4, 8, 7)
    assert np.allclose(best.candidates[0], plain.actions, atol=1e-5), "the first is what would have been taken"
    features = policy.encode([history])
    scores = critic.q(features.expand(4, -1), torch.from_numpy(best.candidates))
    assert np.array_equal(best.actions, best.candidates[int(scores.argmax())])
