"""IQL: expectile regression, targets, transitions, training that resumes exactly, the checkpoint file."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from far_app.errors import CheckpointError, ConfigError
from far_app.learning.critic import Critic, CriticShape, expectile_loss, eyes_of, iql_losses
from far_app.learning.critic_file import load_critic, load_demonstrations, read_card, save_critic
from far_app.learning.critic_source import Features, Pictures, encoded
from far_app.learning.dataset import Episode
from far_app.learning.memory import FeatureMemory
from far_app.learning.train_critic import CriticTraining, fit, train_critic
from far_app.learning.transitions import Backup, EncodedEpisode, Transitions, chunked, joined, labelled, transitions
from tests.learning.small import SIZE, small_attempt, small_policy

SHAPE = CriticShape(features=3, horizon=2, action_dim=2, hidden=(32,))


@given(st.floats(0.05, 0.95))
def test_expectile_loss_weighs_the_two_sides(tau):
    u = torch.tensor([2.0, -3.0])
    assert expectile_loss(u, tau).item() == pytest.approx((tau * 4 + (1 - tau) * 9) / 2, rel=1e-5)


@pytest.mark.parametrize("tau", [0.3, 0.5, 0.7, 0.9])
def test_minimising_it_finds_the_expectile(tau):
    """The τ-expectile m of a sample solves τ E[(x − m)₊] = (1 − τ) E[(m − x)₊]; at τ = ½ it is the mean."""
    x = torch.randn(2000, generator=torch.Generator().manual_seed(0)) ** 3
    m = torch.zeros(1, requires_grad=True)
    optimizer = torch.optim.LBFGS([m], max_iter=100)

    def closure():
        optimizer.zero_grad()
        loss = expectile_loss(x - m, tau)
        loss.backward()
        return loss

    optimizer.step(closure)
    above, below = (x - m).clamp(min=0).mean(), (m - x).clamp(min=0).mean()
    assert (tau * above).item() == pytest.approx(((1 - tau) * below).item(), rel=1e-2)
    if tau == 0.5:
        assert m.item() == pytest.approx(x.mean().item(), abs=1e-3)


def test_the_losses_are_iqls():
    """By hand: target r + γ (1 − done) V(s′); V regresses on the smaller slow Q."""
    torch.manual_seed(0)
    critic = Critic(SHAPE)
    s, a, s2 = torch.randn(4, 3), torch.randn(4, 2, 2), torch.randn(4, 3)
    r, done = torch.tensor([-1.0, -0.5, 0.0, 3.0]), torch.tensor([0.0, 0.0, 1.0, 1.0])
    value_loss, q_loss = iql_losses(critic, s, a, r, s2, 0.9 * (1 - done), tau=0.7)
    v2 = critic.value(s2)
    target = torch.stack([r[0] + 0.9 * v2[0], r[1] + 0.9 * v2[1], r[2], r[3]])
    q1, q2 = critic.twin_q(s, a)
    assert q_loss.item() == pytest.approx((((target - q1) ** 2).mean() + ((target - q2) ** 2).mean()).item(), rel=1e-5)
    u = torch.minimum(*critic.twin_q(s, a, slow=True)) - critic.value(s)
    assert value_loss.item() == pytest.approx((torch.where(u < 0, 0.3, 0.7) * u**2).mean().item(), rel=1e-5)
    assert torch.equal(critic.q(s, a), torch.minimum(q1, q2))


def test_each_loss_moves_its_own_networks_only():
    critic = Critic(SHAPE)
    batch = torch.randn(4, 3), torch.randn(4, 2, 2), torch.zeros(4), torch.randn(4, 3), torch.zeros(4)
    value_loss, q_loss = iql_losses(critic, *batch, tau=0.7)
    value_loss.backward(retain_graph=True)
    assert all(p.grad is None for p in [*critic.q1.parameters(), *critic.slow_q1.parameters()])
    critic.zero_grad()
    q_loss.backward()
    assert all(p.grad is None or not p.grad.any() for p in critic.v.parameters())


def test_slow_networks_follow_at_their_rate():
    critic = Critic(SHAPE)
    with torch.no_grad():
        for p in critic.q1.parameters():
            p.add_(1.0)
    before = [p.clone() for p in critic.slow_q1.parameters()]
    critic.follow(0.005)
    for old, now in zip(before, critic.slow_q1.parameters(), strict=True):
        assert torch.allclose(now - old, torch.full_like(old, 0.005), atol=1e-6)


def test_reward_kinds():
    shaped, success = np.array([0.1, 0.6, 1.0]), np.array([False, False, True])
    assert labelled("shaped", shaped, success) == pytest.approx([-0.9, -0.4, 0.0])
    assert labelled("sparse", shaped, success) == pytest.approx([0, 0, 3])
    assert labelled("real", shaped, success) == pytest.approx([-0.1, -0.1, 3])


def test_chunks_repeat_the_last_action_past_the_end():
    actions = np.arange(3.0)[:, None]
    assert chunked(actions, 3)[:, :, 0].tolist() == [[0, 1, 2], [1, 2, 2], [2, 2, 2]]


def test_an_episode_ends_where_it_succeeds_and_only_there_it_is_done():
    episode = EncodedEpisode(
        features=np.arange(6.0)[:, None], actions=np.zeros((5, 2)), rewards=np.linspace(0, 1, 5),
        success=np.array([False, False, True, True, False]),
    )  # fmt: skip
    found = transitions(episode, 2, "sparse", Backup())
    assert found.discounts.tolist() == pytest.approx([0.99, 0.99, 0])
    assert found.rewards.tolist() == [0, 0, 3]
    assert found.next_features[:, 0].tolist() == [1, 2, 3]


def test_a_time_limit_is_not_an_end():
    episode = EncodedEpisode(
        features=np.zeros((6, 1)), actions=np.zeros((5, 2)), rewards=np.zeros(5), success=np.zeros(5, bool)
    )
    found = transitions(episode, 2, "shaped", Backup())
    assert len(found) == 5
    assert found.discounts.all()


def test_a_longer_backup_adds_up_rewards_and_asks_v_further_on():
    """By hand: n = 2, γ = ½, success at the third tick."""
    episode = EncodedEpisode(
        features=np.arange(5.0)[:, None], actions=np.zeros((4, 2)), rewards=np.array([0.2, 0.4, 1.0, 1.0]),
        success=np.array([False, False, True, True]),
    )  # fmt: skip
    found = transitions(episode, 2, "shaped", Backup(ticks=2, gamma=0.5))
    assert found.rewards.tolist() == pytest.approx([-0.8 + 0.5 * -0.6, -0.6, 0.0])
    assert found.next_features[:, 0].tolist() == [2, 3, 3]
    assert found.discounts.tolist() == [0.25, 0, 0]


def test_a_backup_is_cut_at_the_time_limit_and_v_asked_there():
    episode = EncodedEpisode(
        features=np.arange(4.0)[:, None], actions=np.zeros((3, 2)), rewards=np.zeros(3), success=np.zeros(3, bool)
    )
    found = transitions(episode, 2, "shaped", Backup(ticks=2, gamma=0.5))
    assert found.rewards.tolist() == [-1.5, -1.5, -1]
    assert found.discounts.tolist() == [0.25, 0.25, 0.5]


def corridor(cells: int = 6, repeats: int = 40) -> Transitions:
    """Walk to the right, −1 a step, done at the last cell: V(i) = −(1 − γ^n)/(1 − γ) with n steps to pay."""
    i = np.tile(np.arange(cells), repeats)
    one_hot = np.eye(cells + 1, dtype=np.float32)
    done = (i == cells - 1).astype(np.float32)
    return Transitions(
        features=one_hot[i], chunks=np.zeros((len(i), 2, 2), np.float32), rewards=-(1 - done),
        next_features=one_hot[i + 1], discounts=(0.9 * (1 - done)).astype(np.float32),
    )  # fmt: skip


def test_training_finds_the_value_of_a_corridor(tmp_path):
    critic = Critic(CriticShape(features=7, horizon=2, action_dim=2, hidden=(64,)))
    training = CriticTraining(iterations=2500, lr=2e-3, polyak=0.05, expectile=0.7)
    fit(critic, Features(corridor()), training, tmp_path)
    with torch.no_grad():
        found = critic.value(torch.eye(7)[:6])
    expected = [-(1 - 0.9**n) / 0.1 for n in (5, 4, 3, 2, 1, 0)]
    assert found.tolist() == pytest.approx(expected, abs=0.15)


def test_a_run_that_was_cut_goes_on_to_the_very_same_weights(tmp_path):
    def critic():
        torch.manual_seed(0)
        return Critic(CriticShape(features=7, horizon=2, action_dim=2, hidden=(16,)))

    whole, cut, resumed = critic(), critic(), critic()
    training = CriticTraining(iterations=60, save_every=20, log_every=10)
    fit(whole, Features(corridor()), training, tmp_path / "whole")

    class Killed(Exception):
        pass

    def die_at_45():
        calls = 0

        def follow(rate: float) -> None:
            nonlocal calls
            calls += 1
            if calls == 45:
                raise Killed
            Critic.follow(cut, rate)

        return follow

    cut.follow = die_at_45()
    with pytest.raises(Killed):
        fit(cut, Features(corridor()), training, tmp_path / "cut")
    fit(resumed, Features(corridor()), training, tmp_path / "cut")
    for a, b in zip(whole.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(a, b)


def test_a_folder_of_another_run_is_refused(tmp_path):
    critic = Critic(CriticShape(features=7, horizon=2, action_dim=2, hidden=(16,)))
    fit(critic, Features(corridor()), CriticTraining(iterations=2), tmp_path)
    with pytest.raises(ConfigError, match="another training"):
        fit(critic, Features(corridor()), CriticTraining(iterations=2, gamma=0.5), tmp_path)
    with pytest.raises(ConfigError, match="another stamp"):
        fit(critic, Features(corridor()), CriticTraining(iterations=2), tmp_path, stamp="other encoder")


def episode(ticks: int, success: bool, seed: int = 0) -> Episode:
    rng = np.random.default_rng(seed)
    successes = np.zeros(ticks, bool)
    successes[-1] = success
    states = rng.normal(size=(ticks, 8)).astype(np.float32)
    return Episode(
        images={c: rng.integers(0, 256, (ticks, SIZE, SIZE, 3), dtype=np.uint8) for c in ("front", "wrist")},
        states=states, actions=rng.uniform(-1, 1, (ticks, 7)).astype(np.float32),
        rewards=rng.random(ticks).astype(np.float32), successes=successes, success=success, seed=seed,
    )  # fmt: skip


def test_encoded_features_are_the_policys_own(tmp_path):
    """Features of tick t come from the frames (t − 1, t), the first repeated, across the borders of passes."""
    policy, source = small_policy(), episode(11, success=True)
    found = encoded(policy, source, ticks_at_once=4)
    for t in (0, 1, 4, 10):
        frames = [max(0, t - 1), t]
        images = {c: torch.from_numpy(v[frames])[None] for c, v in source.images.items()}
        expected = policy.features(images, torch.from_numpy(source.states[frames])[None])
        assert np.allclose(found.features[t], expected[0].numpy(), atol=1e-5)
    assert found.rewards.tolist() == source.rewards[1:].tolist()
    assert len(found.actions) == 10


def test_a_trained_critic_loads_for_its_policy_and_for_no_other(tmp_path):
    policy = small_policy()
    path = train_critic(
        [episode(12, True)], [episode(15, False, seed=1)], policy, CriticTraining(iterations=5, hidden=(8,)), tmp_path
    )
    critic = load_critic(path, policy)
    assert critic.shape.features == policy.feature_dim
    assert bool(torch.isfinite(critic.value(torch.zeros(2, policy.feature_dim))).all())
    percentiles = read_card(path)["demonstration_value_change_percentiles"]
    assert percentiles["1"] <= percentiles["50"]
    with pytest.raises(CheckpointError, match="its values would mean nothing"):
        load_critic(path, small_policy(seed=9))


def test_demonstration_chunks_lie_beside_the_critic(tmp_path):
    """Only demonstrations, not attempts; features are the policy's."""
    policy, demonstration = small_policy(), episode(12, True)
    path = train_critic(
        [demonstration], [episode(15, False, seed=1)], policy, CriticTraining(iterations=2, hidden=(8,)), tmp_path
    )
    kept = load_demonstrations(path, policy)
    features = torch.from_numpy(encoded(policy, demonstration).features[:-1])
    assert len(kept.chunks) == 11
    assert torch.allclose(torch.cdist(kept.features, features).min(1).values, torch.zeros(11), atol=1e-3)


def test_pictures_are_the_same_transitions_as_features():
    """Before any training an own encoder is the policy's: both sources give the same batch."""
    policy, episodes = small_policy(), [episode(9, True), episode(7, False, seed=1)]
    critic = Critic(CriticShape(features=policy.feature_dim, horizon=8, action_dim=7, own_eyes=True), eyes_of(policy))
    features = Features(joined([transitions(encoded(policy, e), 8, "shaped", Backup()) for e in episodes]))
    pictures = Pictures(episodes, 8, "shaped", Backup())
    assert len(pictures) == len(features) == 14
    rows = np.array([0, 7, 8, 13, 3])
    for one, other in zip(features.batch(critic, rows), pictures.batch(critic, rows), strict=True):
        assert torch.allclose(one, other, atol=1e-5)


def test_an_own_encoder_is_trained_saved_and_used(tmp_path):
    policy = small_policy()
    training = CriticTraining(iterations=4, batch=8, lr=1e-2, hidden=(8,), encoder="own")
    path = train_critic([episode(12, True)], [], policy, training, tmp_path)
    critic = load_critic(path, policy)
    attempt = small_attempt(ticks=9)
    histories = [(attempt.steps[0].observation, attempt.steps[1].observation)]
    features = policy.encode(histories)
    assert not torch.allclose(critic.see(histories, features, FeatureMemory()), features, atol=1e-4)
    assert sum(v.numel() for v in critic.state_dict().values()) > sum(p.numel() for p in policy.encoder.parameters())


def test_bad_critic_files_say_what_to_do(tmp_path):
    policy = small_policy()
    with pytest.raises(CheckpointError, match="far train critic"):
        load_critic(tmp_path / "absent.safetensors", policy)
    shape = CriticShape(features=policy.feature_dim, horizon=8, action_dim=7, hidden=(8,))
    path = tmp_path / "critic.safetensors"
    save_critic(Critic(shape), policy, path)
    truncated = tmp_path / "truncated.safetensors"
    truncated.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CheckpointError, match="truncated"):
        load_critic(truncated, policy)
