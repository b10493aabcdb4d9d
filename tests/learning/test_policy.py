"""The network, its file, and the policy that acts with it."""

import dataclasses

import numpy as np
import pytest
import torch

from far_app.errors import CheckpointError, ConfigError, PolicyError
from far_app.learning.policy import (
    DiffusionPolicy,
    Normalizer,
    fingerprint,
    load_policy,
    preset,
    read_card,
    save_policy,
)
from far_app.learning.runtime import ActingPolicy
from far_app.types import Observation, Pose, RobotMode, RobotStatus


def small_policy(size: int = 24, encoder: str = "light") -> DiffusionPolicy:
    torch.manual_seed(0)
    config = dataclasses.replace(
        preset("quickstart", "lift"), image_size=size, widths=(16, 32, 64), encoder=encoder, ddim_steps=4
    )
    return DiffusionPolicy(config).eval().requires_grad_(False)


def observations(count: int, size: int = 24) -> list[Observation]:
    rng = np.random.default_rng(0)
    return [
        Observation(
            seq=i, stamp=i / 30, gripper=rng.random(), joints=np.zeros(7), status=RobotStatus(mode=RobotMode.HOLD),
            eef=Pose(position=rng.normal(size=3), quaternion=np.array([0.0, 1.0, 0.0, 0.0])),
            images={c: rng.integers(0, 256, (size, size, 3), np.uint8) for c in ("front", "wrist")},
        )
        for i in range(count)
    ]  # fmt: skip


@pytest.mark.parametrize("encoder", ["light", "resnet18"])
def test_acting_policy_equals_the_network_though_it_keeps_features(encoder):
    policy, seen = small_policy(32 if encoder == "resnet18" else 24, encoder), None
    seen = observations(5, policy.config.image_size)
    acting = ActingPolicy(policy, "v")
    rng = np.random.default_rng(1)
    for t in range(1, 5):
        noise = rng.standard_normal((1, 8, 7), np.float32)
        (chunk,) = acting.plan([(seen[t - 1], seen[t])], [t], noise)
        expected = policy.sample(policy.encode([(seen[t - 1], seen[t])]), torch.from_numpy(noise))[0]
        assert np.allclose(chunk.actions, expected, atol=1e-4)
        assert (chunk.tick, chunk.policy_version) == (t, "v")


def test_a_batch_of_histories_gives_what_each_gives_alone():
    policy, seen = small_policy(), observations(4)
    acting = ActingPolicy(policy, "v")
    noise = np.random.default_rng(1).standard_normal((3, 8, 7), np.float32)
    histories = [(seen[t], seen[t + 1]) for t in range(3)]
    together = acting.plan(histories, [1, 2, 3], noise)
    for i, history in enumerate(histories):
        (alone,) = ActingPolicy(policy, "v").plan([history], [i], noise[i : i + 1])
        assert np.allclose(alone.actions, together[i].actions, atol=1e-4)


def test_the_same_observation_twice_gives_the_same_chunk():
    acting, seen = ActingPolicy(small_policy(), "v"), observations(2)
    noise = np.zeros((1, 8, 7), np.float32)
    first, again = (acting.plan([(seen[0], seen[1])], [0], noise)[0].actions for _ in range(2))
    assert np.array_equal(first, again)


def test_non_finite_plans_are_refused():
    policy = small_policy()
    next(iter(policy.denoiser.parameters())).data.fill_(float("nan"))
    with pytest.raises(PolicyError, match="non-finite action at tick 3"):
        seen = observations(2)
        ActingPolicy(policy, "v").plan([(seen[0], seen[1])], [3], np.zeros((1, 8, 7), np.float32))


def test_quaternions_of_either_sign_mean_the_same():
    normalizer = Normalizer(8)
    states = np.random.default_rng(0).normal(size=(50, 8)).astype(np.float32)
    normalizer.fit(states)
    flipped = states.copy()
    flipped[:, 3:7] *= -1
    assert torch.allclose(normalizer(torch.from_numpy(states)), normalizer(torch.from_numpy(flipped)))
    assert normalizer(torch.from_numpy(states)).abs().max() <= 1.0 + 1e-5


def test_checkpoint_round_trip(tmp_path):
    policy, path = small_policy(), tmp_path / "p.safetensors"
    save_policy(policy, path, {"data": "80 demonstrations"})
    again = load_policy(path, "lift")
    assert again.config == policy.config
    assert fingerprint(again) == fingerprint(policy)
    assert read_card(path) == {"data": "80 demonstrations"}


def test_bad_checkpoints_are_named(tmp_path):
    path = tmp_path / "p.safetensors"
    with pytest.raises(CheckpointError, match="no policy checkpoint"):
        load_policy(path)
    save_policy(small_policy(), path)
    with pytest.raises(CheckpointError, match="trained for task 'lift', this run is 'stack'"):
        load_policy(path, "stack")
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(CheckpointError, match="truncated"):
        load_policy(path)


def test_unknown_presets_list_the_choices():
    with pytest.raises(ConfigError, match="quickstart, paper"):
        preset("huge", "lift")


def test_the_paper_preset_has_the_paper_s_sizes():
    config = preset("paper", "lift")
    assert (config.widths, config.kernel, config.step_dim, config.ddim_steps, config.n_obs) == (
        (64, 128, 256), 3, 16, 16, 2,
    )  # fmt: skip
    assert config.encoder == "resnet18"
