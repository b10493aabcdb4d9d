"""Continual improvement: its scenes, its noise, its log; one real run that goes on where it was cut."""

import dataclasses
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from far_app.cli import main
from far_app.config import PerturbationConfig
from far_app.errors import ConfigError
from far_app.evaluation import DEV_SCENES, REPORT_SCENES
from far_app.improvement import Epoch, Improvement, Noisy, before_and_after, read_log, table
from far_app.learning.critic import Critic, CriticShape
from far_app.learning.critic_file import load_critic, save_critic
from far_app.learning.dataset import Episode, read_episodes
from far_app.learning.improve import Experience, advantage_weights, finetuning, learn
from far_app.learning.policy import DiffusionPolicy, fingerprint, load_policy, preset, save_policy
from far_app.learning.train_critic import CriticTraining
from far_app.perturbation import perturbation
from far_app.recording.episodes import session_episodes

from .recording import sessions, values


def test_no_epoch_collects_where_another_did_or_where_policies_are_judged():
    loops = [Improvement(seed=seed) for seed in (0, 1)]
    scenes = [s for loop in loops for epoch in range(1, 16) for s in loop.scenes(epoch)]
    assert len(set(scenes)) == len(scenes) == 2 * 15 * 20
    assert min(scenes) > max(DEV_SCENES, REPORT_SCENES) + 5_000
    assert [e for e in range(1, 16) if Improvement().evaluated(e)] == [5, 10, 15]
    with pytest.raises(ConfigError, match="episodes is 0, must be at least 1"):
        Improvement(episodes=0)


def test_the_critic_goes_on_under_the_target_and_reward_it_was_trained_with():
    card = {"training": {"reward": "sparse", "backup": 24}}
    known, unknown = Improvement().of_critic(card), Improvement().of_critic({})
    assert (known.reward, known.backup) == ("sparse", 24)
    assert (unknown.reward, unknown.backup) == ("shaped", 8)
    told = Improvement(reward="real", backup=1).of_critic(card)
    assert (told.reward, told.backup) == ("real", 1), "what was asked for stays"
    with pytest.raises(ConfigError, match="backup is 0, must be at least 1 tick"):
        Improvement(backup=0)


class Retrying:
    """The part of a Method that noise is added to."""

    name, policy = "retrying", None
    retry = PerturbationConfig(sigma=1.0, probability=1.0, kind="gaussian")

    def perturb(self, attempt_index, scene_seed):
        return perturbation(self.retry, scene_seed, attempt_index)


def test_every_action_is_noisy_and_a_retry_is_perturbed_besides():
    noisy, bare = Noisy(Retrying(), 0.1), Retrying()
    first = np.stack([noisy.perturb(1, 7)(t) for t in range(400)])
    assert np.abs(first[:, :6].std() - 0.1) < 0.01 and not first[:, 6].any()
    noise = np.stack([noisy.perturb(2, 7)(t) - bare.perturb(2, 7)(t) for t in range(400)])
    retry = np.stack([bare.perturb(2, 7)(t) for t in range(400)])
    assert np.abs(noise[:, :6].std() - 0.1) < 0.01
    correlation = np.corrcoef(noise[:, :6].ravel(), retry[:, :6].ravel())[0, 1]
    assert abs(correlation) < 0.1, "its own numbers, not the retry's again"


def test_a_torn_line_of_the_log_is_left_out(tmp_path):
    path = tmp_path / "log.jsonl"
    epochs = [Epoch(epoch=0, evaluation={"scenes": 50, "solved": 20}), Epoch(epoch=1, episodes=20, timesteps=900)]
    path.write_text("".join(json.dumps(dataclasses.asdict(e)) + "\n" for e in epochs) + '{"epoch": 2, "epi')
    assert read_log(path) == epochs
    assert "| 0 | 0 | 0 | 40.0 [27.6, 53.8] |" in table(epochs)


def models(folder):
    """An untrained state policy for lift, and a critic of it."""
    torch.manual_seed(0)
    policy = DiffusionPolicy(preset("state", "lift")).eval()
    save_policy(policy, folder / "policy.safetensors")
    shape = CriticShape(features=policy.feature_dim, horizon=policy.config.horizon, action_dim=7, hidden=(16,))
    save_critic(Critic(shape), policy, folder / "critic.safetensors")
    return folder / "policy.safetensors", folder / "critic.safetensors"


def episodes(count: int, success: bool) -> list[Episode]:
    rng = np.random.default_rng(count)
    done = np.arange(20) > 16
    return [
        Episode(
            images={}, states=rng.normal(size=(20, 8)).astype(np.float32),
            actions=rng.uniform(-1, 1, (20, 7)).astype(np.float32), rewards=rng.random(20).astype(np.float32),
            successes=done & success, success=success, seed=i, objects=rng.normal(size=(20, 7)).astype(np.float32),
        )
        for i in range(count)
    ]  # fmt: skip


def test_an_epoch_moves_both_models_and_never_the_base(tmp_path):
    base = models(tmp_path / "base")
    before = [p.read_bytes() for p in base]
    experience = Experience(
        demonstrations=episodes(3, True), succeeded=episodes(2, True), failed=episodes(2, False)
    )  # fmt: skip
    training = CriticTraining(iterations=5, backup=8)
    recipe = dataclasses.replace(finetuning("state", 3, 0), batch=8)
    policy, critic = learn(*base, experience, training, recipe, tmp_path / "epoch-01")
    assert [p.read_bytes() for p in base] == before
    old, new = load_policy(base[0]), load_policy(policy)
    assert fingerprint(old.denoiser) != fingerprint(new.denoiser)
    assert fingerprint(old.normalizer) == fingerprint(new.normalizer)
    load_critic(critic, new)  # its features still mean the same
    again = learn(*base, experience, training, recipe, tmp_path / "again")
    assert fingerprint(load_policy(again[0])) == fingerprint(new), "the same seeds, the same weights"
    weights = advantage_weights(new, load_critic(critic, new), episodes(1, True)[0])
    assert weights.shape == (20,) and (weights > 0).all() and weights.max() <= 100 and math.isfinite(weights.sum())


def test_a_recorded_session_is_experience_with_the_last_word_said_on_it(tmp_path):
    folder = sessions.small_session(tmp_path, steps=12)
    failed, succeeded = session_episodes(folder, "lift")
    assert (failed.success, succeeded.success) == (False, True)
    assert len(failed) == 13 and failed.actions.shape == (13, 7)
    assert not failed.successes.any() and succeeded.successes.any()
    with pytest.raises(ConfigError, match="session of task 'lift', these models are for 'can'"):
        session_episodes(folder, "can")


def test_before_and_after_are_compared_scene_by_scene():
    def records(solved):
        return [{"scene": s, "success": s in solved} for s in range(10)]

    line = before_and_after(records({0, 1, 2}), [*records({1, 2, 3, 4, 5, 6, 7}), {"scene": 99, "success": True}])
    assert "same 10 scenes: +40.0 points [" in line and "5 gained, 1 lost" in line and "p = 0.219" in line
    assert "+0.0 points;" in before_and_after(records({1}), records({1}))
    assert "share no scene" in before_and_after([], records({1}))


def test_sessions_that_cannot_tell_before_from_after_are_refused_before_anything_is_evaluated(tmp_path, capsys):
    policy, _ = models(tmp_path / "base")
    pictures = Path(__file__).parents[1] / "recordings" / "sample"
    words = ["improve", "--policy", str(policy), "--out", str(tmp_path / "out"), "--from"]
    copy = tmp_path / "judged"
    shutil.copytree(pictures, copy)
    header = json.loads((copy / "session.json").read_text())
    header["info"]["rig"]["robot"] = "twin"
    (copy / "session.json").write_text(json.dumps(header))
    seed = session_episodes(copy, "lift")[0].seed
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("far_app.cli.improve.REPORT_SCENES", seed)
        assert main([*words, str(copy)]) == 2
    assert f"its scene {seed} is one that before and after are judged on" in capsys.readouterr().err
    small = sessions.small_session(tmp_path, steps=4)
    out = ["--out", str(tmp_path / "out"), "--data", str(tmp_path / "none.hdf5")]
    assert main(["improve", *out, "--from", str(small)]) == 2
    assert "no demonstrations at" in capsys.readouterr().err
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(values, "frame", lambda number, camera, size=96: np.zeros((96, 96, 3), np.uint8))
        large = sessions.small_session(tmp_path / "large", steps=4)
    assert main(["improve", *out, "--from", str(large)]) == 2
    assert "pictures of 96×96 of camera 'front'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_policy_is_finetuned_on_the_sample_session(tmp_path, capsys):
    sample = Path(__file__).parents[1] / "recordings" / "sample"
    data = tmp_path / "lift.hdf5"
    assert main(["demo", "--n", "1", "--out", str(data)]) == 0
    out = tmp_path / "improved"
    words = ["improve", "--from", str(sample), "--data", str(data), "--out", str(out)]
    few = ["--loop.critic-iterations", "4", "--loop.policy-iterations", "2", "--loop.evaluation-scenes", "1"]
    assert main([*words, *few]) == 0
    before, after = read_log(out / "log.jsonl")
    assert before.evaluation is not None and after.evaluation is not None
    assert after.successes + after.failures == len(session_episodes(sample, "lift")) > 0
    assert (out / "epoch-01" / "policy.safetensors").exists()
    assert "after − before on the same 1 scenes" in capsys.readouterr().out


@pytest.mark.slow
def test_an_improvement_goes_on_where_it_was_cut(tmp_path, monkeypatch):
    policy, _ = models(tmp_path / "base")
    data = tmp_path / "lift.hdf5"
    assert main(["demo", "--rig", "panda", "--n", "1", "--no-images", "--out", str(data)]) == 0
    words = [
        "improve", "--rig", "panda", "--collector", "nr", "--policy", str(policy), "--data", str(data),
        "--loop.episodes", "2", "--loop.attempts", "2", "--loop.critic-iterations", "4",
        "--loop.policy-iterations", "2", "--loop.evaluate-every", "1", "--loop.evaluation-scenes", "1",
        "--loop.epochs",
    ]  # fmt: skip
    whole = tmp_path / "whole"
    assert main([*words, "2", "--out", str(whole)]) == 0
    log = read_log(whole / "log.jsonl")
    assert [e.epoch for e in log] == [0, 1, 2] and log[2].episodes == 4 and log[2].evaluation is not None
    assert len(read_episodes(whole / "epoch-01" / "attempts.hdf5", ())) == 4, "every attempt of both episodes"

    parts = tmp_path / "parts"
    assert main([*words, "1", "--out", str(parts)]) == 0
    with monkeypatch.context() as patch:
        patch.setattr("far_app.learning.improve.fit", lambda *a, **k: (_ for _ in ()).throw(KeyboardInterrupt))
        assert main([*words, "2", "--out", str(parts)]) == 130
    assert main([*words, "2", "--out", str(parts)]) == 0
    assert read_log(parts / "log.jsonl") == log
    assert (parts / "epoch-02/policy.safetensors").read_bytes()[-1000:] == (
        whole / "epoch-02/policy.safetensors"
    ).read_bytes()[-1000:]
    assert main([*words, "2", "--loop.noise", "0.2", "--out", str(parts)]) == 2, "another run's folder is refused"
