"""The success head: conformal thresholds keep their promise, labels need outcomes alone, the file knows its policy."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from far_app.bench.success import report, verdict
from far_app.errors import CheckpointError, ConfigError
from far_app.learning.dataset import Episode, write_episode
from far_app.learning.policy import save_policy
from far_app.learning.success import (
    LearnedDetector,
    SuccessHead,
    SuccessRule,
    agreed,
    best,
    conformal_lower,
    conformal_threshold,
    load_detector,
    read_card,
    save_detector,
)
from far_app.learning.train_success import SuccessTraining, Watched, train_success, watch
from far_app.protocols import SuccessDetector
from far_app.types import Judge
from tests.learning.small import SIZE, observation, small_policy

RULE = SuccessRule(consecutive=3, threshold=2.0, lower=1.0)


@pytest.mark.parametrize("alpha", [0.02, 0.1, 0.3])
def test_a_new_failure_is_taken_for_a_success_at_most_so_often(alpha):
    rng = np.random.default_rng(0)
    wrong = [rng.gumbel() > conformal_threshold(rng.gumbel(size=120), alpha) for _ in range(4000)]
    assert np.mean(wrong) < alpha + 3 * math.sqrt(alpha / 4000)
    assert np.mean(wrong) > alpha - 2 / 121 - 3 * math.sqrt(alpha / 4000), "and not needlessly strict"


def test_a_new_success_scores_below_the_lower_threshold_at_most_so_often():
    rng = np.random.default_rng(1)
    missed = [rng.normal() < conformal_lower(rng.normal(size=99), 0.05) for _ in range(4000)]
    assert np.mean(missed) < 0.06
    assert conformal_lower(np.zeros(5), 0.05) == -math.inf, "too few to know"


def test_too_few_failures_for_the_rate_say_how_many_are_needed():
    with pytest.raises(ConfigError, match="at least 99 failed attempts to calibrate on, there are 98"):
        conformal_threshold(np.zeros(98), 0.01)
    assert conformal_threshold(np.arange(99.0), 0.01) == 98.0


def test_frames_in_a_row_must_agree():
    scores = np.array([5.0, 5.0, -1.0, 3.0, 4.0, 3.5, 0.0])
    assert agreed(scores, 3).tolist() == [-1.0, -1.0, -1.0, 3.0, 0.0] and best(scores, 3) == 3.0
    assert best(scores[:2], 3) == -math.inf


class Scored(SuccessHead):
    """Scores as told."""

    def __init__(self, features: int, scores: list[float]) -> None:
        super().__init__(features)
        self.scores = scores

    def forward(self, features):
        return torch.tensor([self.scores.pop(0)])


def test_the_detector_ends_an_attempt_when_enough_frames_agree_and_forgets_the_last_attempt():
    policy = small_policy()
    head = Scored(policy.feature_dim, [3.0, 3.0, 1.5, 3.0, 3.0, 3.0, 9.0])
    detector = LearnedDetector(policy, head, RULE, wait=7.0)
    assert isinstance(detector, SuccessDetector)
    rng = np.random.default_rng(0)
    detector.begin()
    said = [detector.judge(observation(i, rng)) for i in range(6)]
    assert said[:5] == [None] * 5 and said[5] is not None
    assert (said[5].success, said[5].judged_by) == (True, Judge.DETECTOR) and "score 3.00" in said[5].note
    detector.begin()
    assert detector.judge(observation(9, rng)) is None and detector.best == -math.inf


@pytest.mark.parametrize(("score", "patience"), [(0.5, 0.0), (1.5, 7.0), (2.5, 0.0)])
def test_the_operator_is_asked_only_when_the_detector_is_unsure(score, patience):
    policy = small_policy()
    detector = LearnedDetector(policy, Scored(policy.feature_dim, [score] * 3), RULE, wait=7.0)
    detector.begin()
    for i in range(3):
        detector.judge(observation(i, np.random.default_rng(i)))
    assert detector.patience == patience


def attempts(count: int, success: bool, seed: int, length: int = 50) -> list[Watched]:
    """Features that drift upwards at the end of a success, and wander in a failure."""
    rng = np.random.default_rng(seed)
    made = []
    for i in range(count):
        features = rng.normal(size=(length, 6)).astype(np.float32)
        features[:, 0] += np.clip(np.arange(length) - (length - 16), 0, 6) if success else 0.0
        made.append(Watched(features=features, success=success, seed=1000 * seed + i))
    return made


def test_it_learns_from_outcomes_alone_and_keeps_its_promise_on_new_attempts():
    training = SuccessTraining(iterations=300, false_success=0.05, consecutive=3)
    head, rule, card = train_success(
        attempts(20, True, 1), [*attempts(80, True, 2), *attempts(120, False, 3)], training
    )
    assert card["calibrated_on_failures"] >= 40 and len(card["scenes"]) == 220  # type: ignore[arg-type, operator]
    wrong = [best(head(torch.from_numpy(w.features)).numpy(), 3) > rule.threshold for w in attempts(300, False, 4)]
    found = [best(head(torch.from_numpy(w.features)).numpy(), 3) > rule.threshold for w in attempts(300, True, 5)]
    assert np.mean(wrong) < 0.10 and np.mean(found) > 0.9
    again, same, _ = train_success(attempts(20, True, 1), [*attempts(80, True, 2), *attempts(120, False, 3)], training)
    assert same == rule and torch.equal(again.net[0].weight, head.net[0].weight), "repeatable"


def test_without_failures_there_is_nothing_to_learn():
    with pytest.raises(ConfigError, match="successes and failures"):
        train_success(attempts(5, True, 1), attempts(5, True, 2), SuccessTraining())


def test_frames_near_the_end_of_a_success_are_neither():
    (success,), (failure,) = attempts(1, True, 1), attempts(1, False, 2)
    training = SuccessTraining(last=10, gap=10)
    assert (success.early(training), failure.early(training)) == (30, 50)


def test_a_detector_survives_the_disk_and_belongs_to_one_policy(tmp_path):
    policy, path = small_policy(), tmp_path / "success.safetensors"
    torch.manual_seed(3)
    head = SuccessHead(policy.feature_dim)
    save_detector(head, RULE, policy, path, {"scenes": [1, 2]})
    again = load_detector(path, policy)
    assert again.rule == RULE and read_card(path)["scenes"] == [1, 2]
    features = torch.randn(4, policy.feature_dim)
    assert torch.equal(again.head(features), head(features))
    with pytest.raises(CheckpointError, match="far train success"):
        load_detector(path, small_policy(seed=9))
    with pytest.raises(CheckpointError, match="no success detector"):
        load_detector(tmp_path / "none.safetensors", policy)
    path.write_bytes(b"\x10\x00")
    with pytest.raises(CheckpointError, match="truncated"):
        load_detector(path, policy)


def test_features_of_a_whole_attempt_are_those_the_live_detector_sees():
    policy, rng = small_policy(), np.random.default_rng(0)
    seen = [observation(i, rng) for i in range(5)]
    states = np.stack([np.concatenate([o.eef.position, o.eef.quaternion, [o.gripper]]) for o in seen])
    episode = Episode(
        images={c: np.stack([o.images[c] for o in seen]) for c in ("front", "wrist")},
        states=states.astype(np.float32), actions=np.zeros((5, 7), np.float32), rewards=np.zeros(5, np.float32),
        successes=np.zeros(5, bool), success=False, seed=1,
    )  # fmt: skip
    (watched,) = watch(policy, [episode])
    torch.manual_seed(3)
    head = SuccessHead(policy.feature_dim)
    detector = LearnedDetector(policy, head, SuccessRule(consecutive=1, threshold=99.0))
    detector.begin()
    expected = head(torch.from_numpy(watched.features)).detach().numpy()
    for one, score in zip(seen, expected, strict=True):
        detector.judge(one)
        assert detector._scores[-1] == pytest.approx(score, abs=1e-4)


# ── far bench success ──


def test_a_verdict_tells_right_wrong_premature_and_unsure():
    rule = SuccessRule(consecutive=2, threshold=1.0, lower=0.0)
    scores = np.full(20, -5.0)
    check = np.zeros(20, bool)
    nothing = verdict(scores, check, rule, held=3)
    assert not (nothing.success or nothing.claimed or nothing.unsure)
    check[12:] = True
    late = scores.copy()
    late[15:] = 4.0
    found = verdict(late, check, rule, held=3)
    assert (found.success, found.claimed, found.premature, found.delay) == (True, True, False, 2.0)
    late[3:5] = 4.0
    assert verdict(late, check, rule, held=3).premature and not verdict(late, check, rule, held=3).claimed
    assert verdict(late, np.zeros(20, bool), rule, held=3).claimed, "a false success"
    assert verdict(np.full(20, 0.5), check, rule, held=3).unsure


def test_the_report_counts_per_attempt():
    rule = SuccessRule(consecutive=2, threshold=1.0, lower=0.0)
    check = np.arange(20) > 10
    good, bad = np.where(check, 4.0, -4.0), np.full(20, -4.0)
    verdicts = [verdict(good, check, rule, 3)] * 3 + [verdict(bad, check, rule, 3)]
    verdicts += [verdict(bad, np.zeros(20, bool), rule, 3)] * 4
    told = report(verdicts)
    assert (told["balanced_accuracy"], told["found"]["count"], told["false_success"]["count"]) == (0.875, 3, 0)
    with pytest.raises(ConfigError, match="both are needed"):
        report(verdicts[:3])


def test_both_commands_whole_and_no_scene_in_both(tmp_path, capsys):
    from far_app.cli import main

    policy = small_policy()
    save_policy(policy, tmp_path / "policy.safetensors")
    rng = np.random.default_rng(0)

    def write(name: str, success: bool, count: int, first: int) -> str:
        for seed in range(first, first + count):
            states = rng.normal(size=(40, 8)).astype(np.float32) * 0.1
            states[:, 7] = np.where(np.arange(40) > 20, 1.0, 0.0) if success else 0.0
            write_episode(tmp_path / name, Episode(
                images={c: np.zeros((40, SIZE, SIZE, 3), np.uint8) for c in ("front", "wrist")}, states=states,
                actions=np.zeros((40, 7), np.float32), rewards=np.zeros(40, np.float32),
                successes=np.arange(40) > 20 if success else np.zeros(40, bool), success=success, seed=seed,
            ), {"env_name": "Lift"})  # fmt: skip
        return str(tmp_path / name)

    shown = write("demos.hdf5", True, 6, 0)
    tried = [write("good.hdf5", True, 10, 100), write("bad.hdf5", False, 24, 200)]
    new = [write("new-good.hdf5", True, 5, 300), write("new-bad.hdf5", False, 5, 400)]
    out = str(tmp_path / "success.safetensors")
    assert main(["train", "success", "--policy", str(tmp_path / "policy.safetensors"), "--data", shown, "--attempts",
                 *tried, "--out", out, "--false-success", "0.2"]) == 0  # fmt: skip
    assert "at a false-success rate of 0.2" in capsys.readouterr().out
    bench = ["bench", "success", "--policy", str(tmp_path / "policy.safetensors"), "--detector", out, "--attempts"]
    assert main([*bench, *new, "--json", str(tmp_path / "report.json")]) == 0
    assert (tmp_path / "report.json").exists()
    capsys.readouterr()
    assert main([*bench, *tried]) == 2
    assert "were used to make" in capsys.readouterr().err
    assert dataclasses.asdict(load_detector(tmp_path / "success.safetensors", policy).rule)["false_success"] == 0.2
