"""The failure alarm: its scores, its conformal promise, and an attempt that it ends."""

import math
from dataclasses import replace

import numpy as np
import pytest

from far_app.aggregation import Plan
from far_app.alarm import (
    AlarmLimits,
    FailureAlarm,
    Listening,
    Scores,
    calibrated,
    conformal_limit,
    passed,
    read_limits,
)
from far_app.attempt import Setting
from far_app.bench.alarm import ended, report
from far_app.cli.train_alarm import Heard
from far_app.detectors import TwinCheck
from far_app.errors import CheckpointError, ConfigError
from far_app.motion import ActionScale
from far_app.session.lockstep import adapt_at_once, run_lockstep
from far_app.session.planners import LockstepPlanner
from far_app.tasks import task
from far_app.trial import trial
from far_app.types import ActionChunk, Judge
from tests.session.kinematic import Faster, Forward, KinematicRobot

CALM = AlarmLimits(unrest=0.5, stagnation=20, false_alarm=0.1, successes=19)


def chunk(tick: int, action: float, value: float = math.nan) -> ActionChunk:
    return ActionChunk(tick=tick, actions=np.full((8, 7), action), policy_version="base", value=value)


def test_agreeing_chunks_have_no_spread_and_the_gripper_does_not_count():
    plan = Plan(horizon=8)
    plan.add(chunk(0, 0.2))
    assert math.isnan(plan.spread(0))
    plan.add(chunk(1, 0.2))
    assert plan.spread(1) == 0.0
    other = np.full((8, 7), 0.2)
    other[:, 6] = -1.0
    plan.add(ActionChunk(tick=2, actions=other, policy_version="base"))
    assert plan.spread(2) == pytest.approx(0.0, abs=1e-12)
    plan.add(chunk(3, 0.6))
    assert plan.spread(3) == pytest.approx(math.sqrt(6 * (3 * 0.1**2 + 0.3**2) / 4))


def test_stagnation_counts_from_the_best_value_so_far():
    scores, plan, seen = Scores(), Plan(horizon=8), []
    for tick, value in enumerate([1.0, 2.0, 1.5, math.nan, 1.9, 2.1]):
        plan.add(chunk(tick, 0.0, value))
        scores.look(plan, tick)
        seen.append(scores.stagnation)
    assert seen == [0, 0, 1, 2, 3, 0]


def test_of_new_successes_no_more_are_lost_than_was_asked_for():
    rng = np.random.default_rng(0)
    lost = []
    for _ in range(300):
        unrest, stagnation = rng.gamma(2.0, 0.1, 60), rng.gamma(5.0, 4.0, 60)
        limits = calibrated([[(u, s)] for u, s in zip(unrest[:59], stagnation[:59], strict=True)], 0.1)
        lost.append(bool(passed(unrest[59], stagnation[59], limits)))
    assert np.mean(lost) < 0.1 + 3 * math.sqrt(0.1 * 0.9 / 300)


def test_too_few_successes_are_refused_with_how_many_are_needed():
    assert conformal_limit([3.0, 1.0, 2.0], 0.25) == 3.0
    with pytest.raises(ConfigError, match="3 successes cannot tell a limit that 5 % exceed; at least 19 are needed"):
        conformal_limit([3.0, 1.0, 2.0], 0.05)


def test_a_file_of_limits_is_for_one_policy(tmp_path):
    path = tmp_path / "alarm.json"
    replace(CALM, policy="abc").write(path)
    assert read_limits(path, "abc") == replace(CALM, policy="abc")
    with pytest.raises(CheckpointError, match="another policy"):
        read_limits(path, "def")
    with pytest.raises(ConfigError, match="make one with `far train alarm`"):
        read_limits(tmp_path / "none.json", "abc")


def test_an_attempt_that_gets_nowhere_ends_early_and_counts_as_a_failure_to_learn_from():
    once = replace(task("lift"), horizon=60, max_attempts=1)

    def run(alarm):
        clock = iter(range(10**6))
        setting = Setting(
            robot=KinematicRobot(), planner=LockstepPlanner(), detector=TwinCheck(2), task=once, scale=ActionScale(),
            alarm=alarm,
        )  # fmt: skip
        events = trial(0, Faster(Forward(speed=0.0)), setting, adapt_at_once)
        return run_lockstep(events, lambda: 1000.0 + next(clock) / 30).attempts[0]

    listening = Listening()
    assert len(run(listening).steps) == 60
    assert len(listening.attempts) == 1 and len(listening.attempts[0]) == 61
    attempt = run(FailureAlarm(CALM))
    assert len(attempt.steps) == 21
    assert (attempt.outcome.success, attempt.outcome.judged_by) == (False, Judge.DETECTOR)
    assert "has not risen for 21 ticks (limit 20)" in attempt.outcome.note


def test_the_bench_tells_what_is_saved_and_what_is_lost():
    quick = Heard(success=True, scores=[(0.0, t) for t in range(15)])
    slow = Heard(success=True, scores=[(0.0, t) for t in range(30)])
    failure = Heard(success=False, scores=[(0.0, t) for t in range(100)])
    restless = Heard(success=False, scores=[(0.1 * t, 0) for t in range(100)])
    assert [ended(h, CALM) for h in (quick, slow, failure, restless)] == [None, 21, 21, 6]
    found = report([quick, slow, failure, restless], CALM)
    assert found["successes_lost"]["count"] == 1 and found["failures_noticed"]["count"] == 2
    assert found["ticks_saved"] == 79 + 94 and found["share_saved"] == round(173 / 200, 3)
    with pytest.raises(ConfigError, match="both are needed"):
        report([quick], CALM)
