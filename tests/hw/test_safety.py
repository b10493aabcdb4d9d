"""Laws of the safety filter, judged from its outputs alone, over random lives of an arm; and that each needs its rule.

A life begins at rest, inside the box or outside, and meets targets (near, far, huge, turned, stale, sent twice, out of
order, not numbers), path points and braking in any order. What comes out is compared with what came out before.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from far_app.motion import quat_from_rotvec, quat_multiply, rotation_between
from far_app.types import Pose, Target
from hw import safety
from hw.rig import SafetyLimits
from hw.safety import Along, Brake, Follow, SafetyState, Verdict, safety_filter, violation

LIMITS = SafetyLimits(box_min=(0.2, -0.3, -0.1), box_max=(0.7, 0.3, 0.4))
PERIOD, RAMP = 1 / 120, 4
SLACK = 1e-9
FAST = settings(deadline=None, database=None, suppress_health_check=[*HealthCheck])
SEEDS = st.integers(0, 2**48)


class LawBroken(AssertionError):
    """Which law, as the first argument."""


def law(holds: bool, name: str, detail: object = "") -> None:
    if not holds:
        raise LawBroken(name, detail)


@dataclass(frozen=True, kw_only=True)
class Output:
    before: SafetyState
    command: Target | Follow | Along | Brake
    verdict: Verdict
    spoilt: bool
    """A target that must not be admitted."""


def random_turn(rng: np.random.Generator, angle: float) -> np.ndarray:
    return quat_from_rotvec(rng.normal(size=3) * angle)


def random_pose(rng: np.random.Generator, inside: bool) -> Pose:
    low, high = np.array(LIMITS.box_min), np.array(LIMITS.box_max)
    position = rng.uniform(low, high)
    wall = rng.random(3) < 0.4
    position[wall] = np.where(rng.random(3) < 0.5, low, high)[wall]  # on a face, an edge, a corner
    close = rng.random(3) < 0.3
    position[close] = np.clip(position, low, low + 0.02)[close]
    while not inside and violation(position, LIMITS) == 0.0:
        position = rng.uniform(low - 0.1, high + 0.1)
    return Pose(position=position, quaternion=random_turn(rng, 2.0))


def random_target(rng: np.random.Generator, seq: int, state: SafetyState) -> Target:
    reach = rng.choice([0.003, 0.012, 0.03, 1.0, 1e12, 1e308], p=[0.35, 0.25, 0.2, 0.1, 0.05, 0.05])
    position = np.clip(rng.normal(size=3), -1.7, 1.7) * reach
    quaternion = quat_multiply(random_turn(rng, rng.choice([0.02, 0.2, 2.0])), state.goal.quaternion)
    return Target(
        seq=seq, pose=Pose(position=state.goal.position + position, quaternion=quaternion),
        gripper=float(rng.normal()), created=0.0, expires=1.0,
    )  # fmt: skip


DAMAGES = ("not a number", "sent twice", "out of order", "expired", "of the future")
NOW = 0.5


def damaged(rng: np.random.Generator, target: Target) -> Target:
    """As a broken policy, a slow link or a wrong clock would have it: never to be admitted."""
    match rng.choice(DAMAGES):
        case "not a number":
            numbers = np.array([*target.pose.position, *target.pose.quaternion, target.gripper])
            numbers[rng.integers(len(numbers))] = rng.choice([math.nan, math.inf, -math.inf])
            pose = Pose(position=numbers[:3], quaternion=numbers[3:7])
            return replace(target, pose=pose, gripper=float(numbers[7]))
        case "sent twice":
            return replace(target, seq=target.seq - 1)
        case "out of order":
            return replace(target, seq=target.seq - 1 - int(rng.integers(1, 5)))
        case "expired":
            return replace(target, expires=NOW - float(rng.uniform(1e-6, 0.4)))
        case _:
            return replace(target, created=NOW + safety.FUTURE + float(rng.uniform(1e-6, 5.0)))


def life(seed: int, inside: bool, length: int) -> Iterator[Output]:
    """What goes in and comes out, a command at a time; habits persist for a while, as in a real arm's life."""
    rng = np.random.default_rng(seed)
    state = SafetyState.at_rest(random_pose(rng, inside), PERIOD, RAMP)
    heading = rng.normal(size=3) * 0.012
    path = random_pose(rng, inside=bool(rng.random() < 0.7))
    habits, shares = ["stream", "wild", "path", "brake"], [0.45, 0.35, 0.1, 0.1]
    habit = rng.choice(habits, p=shares)
    for i in range(length):
        if rng.random() < 0.1:
            habit, heading = rng.choice(habits), rng.normal(size=3) * 0.02
        command: Target | Follow | Along | Brake = Follow()
        spoilt = False
        if habit == "stream" and i % RAMP == 0:
            pose = Pose(position=state.goal.position + heading, quaternion=state.goal.quaternion)
            command = Target(seq=state.last_seq + 1, pose=pose, gripper=0.0, created=0.0, expires=1.0)
        elif habit == "wild" and rng.random() < 0.4:
            command = random_target(rng, state.last_seq + 1, state)
        elif habit == "path":
            command = Along(pose=path)
        elif habit == "brake":
            command = Brake()
        if isinstance(command, Target) and rng.random() < 0.3:
            command, spoilt = damaged(rng, command), True
        verdict = safety_filter(state, command, LIMITS, NOW)
        yield Output(before=state, command=command, verdict=verdict, spoilt=spoilt)
        state = verdict.state


def check_life(seed: int, inside: bool, length: int = 12) -> None:
    """Speed, acceleration and box, from one output pose to the next; step and box of every target between."""
    velocity, spin = np.zeros(3), np.zeros(3)
    for output in life(seed, inside, length):
        if isinstance(output.command, Target):
            check_target(output, output.command, inside)
            continue
        before, after = output.before.pose, output.verdict.pose
        new_velocity = (after.position - before.position) / PERIOD
        new_spin = rotation_between(before.quaternion, after.quaternion) / PERIOD
        law(bool(np.isfinite(after.position).all() and np.isfinite(after.quaternion).all()), "finite")
        law(abs(math.hypot(*after.quaternion) - 1.0) < 1e-9, "unit quaternion")
        law(math.hypot(*new_velocity) <= LIMITS.speed + SLACK, "speed", math.hypot(*new_velocity))
        law(math.hypot(*new_spin) <= LIMITS.rotation_speed + 1e-6, "rotation speed", math.hypot(*new_spin))
        change, turn_change = math.dist(new_velocity, velocity), math.dist(new_spin, spin)
        law(change <= LIMITS.acceleration * PERIOD + SLACK, "acceleration", change / PERIOD)
        law(turn_change <= LIMITS.rotation_acceleration * PERIOD + 1e-6, "rotation acceleration", turn_change / PERIOD)
        outside = violation(before.position, LIMITS)
        if outside == 0.0:
            law(violation(after.position, LIMITS) == 0.0, "box", after.position)
        else:
            check_outside(before, after, new_spin, spin)
        velocity, spin = new_velocity, new_spin


def check_target(output: Output, target: Target, inside: bool) -> None:
    """Admitted: at most a step beyond the last, and inside the box. A spoilt one is refused and changes nothing."""
    verdict, last = output.verdict, output.before.goal
    law(bool(verdict.refused) == output.spoilt, "refusal", target)
    if verdict.refused:
        law(verdict.state is output.before, "refused without a trace")
        return
    if not inside:
        return  # its goal is drawn toward the box, however far that is; motion is judged above
    goal = verdict.pose
    law(math.dist(goal.position, last.position) <= LIMITS.step_translation + SLACK, "step translation")
    turn = math.hypot(*rotation_between(last.quaternion, goal.quaternion))
    law(turn <= LIMITS.step_rotation + 1e-7, "step rotation", turn)
    law(violation(goal.position, LIMITS) == 0.0, "goal in box", goal.position)
    same = np.allclose(goal.position, np.clip(target.pose.position, -1e3, 1e3), atol=1e-6, rtol=0)
    law(verdict.clipped or bool(same), "clipping is told")


def check_outside(before: Pose, after: Pose, new_spin: np.ndarray, spin: np.ndarray) -> None:
    """From outside: no axis gets worse, and what moves lessens the violation."""
    low, high = np.array(LIMITS.box_min), np.array(LIMITS.box_max)
    excess_before = np.maximum(np.maximum(low - before.position, before.position - high), 0)
    excess_after = np.maximum(np.maximum(low - after.position, after.position - high), 0)
    law(bool((excess_after <= excess_before + 1e-12).all()), "outside", "an axis got worse")
    still = math.dist(after.position, before.position) == 0.0
    law(still or violation(after.position, LIMITS) < violation(before.position, LIMITS), "outside", "not lessened")
    law(not still or math.hypot(*new_spin) <= math.hypot(*spin) + 1e-6, "outside", "turning on the spot")


@settings(FAST, max_examples=8000)
@given(seed=SEEDS)
def test_from_inside_motion_stays_inside_and_under_every_limit(seed: int) -> None:
    check_life(seed, inside=True)


@settings(FAST, max_examples=2000)
@given(seed=SEEDS)
def test_from_outside_only_motion_that_lessens_the_violation_passes(seed: int) -> None:
    check_life(seed, inside=False)


NOT_NUMBERS = st.sampled_from([math.nan, math.inf, -math.inf])


@settings(FAST, max_examples=1000)
@given(seed=SEEDS, where=st.integers(0, 9), value=NOT_NUMBERS)
def test_what_is_not_a_number_is_refused_and_changes_nothing(seed: int, where: int, value: float) -> None:
    rng = np.random.default_rng(seed)
    state = SafetyState.at_rest(random_pose(rng, inside=True), PERIOD, RAMP)
    numbers = [*state.pose.position, *state.pose.quaternion, 0.0, 0.0, 1.0]
    numbers[where] = value
    target = Target(
        seq=1, pose=Pose(position=np.array(numbers[:3]), quaternion=np.array(numbers[3:7])),
        gripper=numbers[7], created=numbers[8], expires=numbers[9],
    )  # fmt: skip
    verdict = safety_filter(state, target, LIMITS, 0.5)
    assert "not a finite number" in verdict.refused
    assert verdict.state is state


@settings(FAST, max_examples=2000)
@given(
    last=st.integers(0, 1000), step=st.integers(-3, 3), created=st.floats(-10, 10), life_time=st.floats(0, 0.2),
    now=st.floats(-10, 10),
)  # fmt: skip
def test_only_fresh_targets_in_order_are_admitted(
    last: int, step: int, created: float, life_time: float, now: float
) -> None:
    pose = Pose(position=np.array((0.4, 0.0, 0.1)), quaternion=np.array((0.0, 1.0, 0.0, 0.0)))
    state = SafetyState.at_rest(pose, PERIOD, RAMP, last_seq=last)
    target = Target(seq=last + step, pose=pose, gripper=0.0, created=created, expires=created + life_time)
    verdict = safety_filter(state, target, LIMITS, now)
    fresh = step > 0 and created <= now + safety.FUTURE and now <= created + life_time
    assert bool(verdict.refused) != fresh
    assert (verdict.state is state) == bool(verdict.refused)
    assert fresh == (verdict.state.last_seq == last + step and step > 0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seq": 7}, "out of order or sent twice"),
        ({"seq": 5}, "out of order or sent twice"),
        ({"expires": 0.4}, "expired 100 ms before"),
        ({"created": 0.9}, "from the future"),
        ({"pose": Pose(position=np.zeros(3), quaternion=np.array((0.0, 0.0, 0.0, 1.2)))}, "length 1.2, must be 1"),
    ],
)
def test_a_refusal_says_what_and_why(change: dict[str, object], words: str) -> None:
    pose = Pose(position=np.array((0.4, 0.0, 0.1)), quaternion=np.array((0.0, 1.0, 0.0, 0.0)))
    state = SafetyState.at_rest(pose, PERIOD, RAMP, last_seq=7)
    fields: dict[str, object] = {"seq": 8, "pose": pose, "gripper": 0.0, "created": 0.4, "expires": 0.6}
    verdict = safety_filter(state, Target(**(fields | change)), LIMITS, 0.5)  # type: ignore[arg-type]
    assert words in verdict.refused


def lives(inside: bool) -> None:
    for seed in range(150):
        check_life(seed, inside, length=40)


def admit_all(state: SafetyState, target: Target, now: float) -> str:
    return ""


RULES = [
    ("refusal", admit_all, True, {"refusal"}),
    ("limit_length", lambda vector, limit: vector, True, {"speed", "rotation speed"}),
    ("limit_change", lambda wish, before, limit: wish, True, {"acceleration", "rotation acceleration"}),
    ("keep_in_box", lambda here, before, velocity, limits, period: velocity, True, {"acceleration"}),
    ("lessens", lambda way, end, limits: True, False, {"acceleration"}),
    ("near", lambda anchor, wish, reach: wish, True, {"step translation"}),
    ("near_turn", lambda anchor, wish, reach: wish, True, {"step rotation"}),
    ("keep_goal_in_box", lambda position, wish, limits: wish, True, {"goal in box"}),
]


@pytest.mark.parametrize(("rule", "removed", "inside", "broken"), RULES, ids=[r[0] for r in RULES])
def test_each_law_fails_without_its_rule(rule, removed, inside, broken, monkeypatch: pytest.MonkeyPatch) -> None:
    lives(inside)
    monkeypatch.setattr(safety, rule, removed)
    with pytest.raises(LawBroken) as caught:
        lives(inside)
    assert caught.value.args[0] in broken


def test_a_steady_stream_is_followed_within_one_ramp() -> None:
    """At 0.24 m/s (a full action on one axis) the command trails its target by no more than the ramp itself."""
    pose = Pose(position=np.array((0.3, 0.0, 0.1)), quaternion=np.array((0.0, 1.0, 0.0, 0.0)))
    state = SafetyState.at_rest(pose, PERIOD, RAMP)
    for i in range(12):
        goal = Pose(position=state.goal.position + np.array((0.008, 0, 0)), quaternion=pose.quaternion)
        target = Target(seq=i, pose=goal, gripper=0.0, created=0.0, expires=1.0)
        verdict = safety_filter(state, target, LIMITS, 0.0)
        assert not verdict.clipped
        state = verdict.state
        for _ in range(RAMP):
            state = safety_filter(state, Follow(), LIMITS, 0.0).state
        if i >= 2:
            assert math.dist(state.pose.position, goal.position) < 1e-6


def test_targets_in_a_burst_cannot_run_ahead_of_the_arm() -> None:
    pose = Pose(position=np.array((0.3, 0.0, 0.1)), quaternion=np.array((0.0, 1.0, 0.0, 0.0)))
    state = SafetyState.at_rest(pose, PERIOD, RAMP)
    for i in range(50):
        goal = Pose(position=state.goal.position + np.array((0.012, 0, 0)), quaternion=pose.quaternion)
        state = safety_filter(state, Target(seq=i, pose=goal, gripper=0.0, created=0.0, expires=1.0), LIMITS, 0.0).state
    assert math.dist(state.goal.position, pose.position) <= safety.REACH * LIMITS.step_translation + SLACK


def test_full_braking_from_full_speed_takes_less_than_50_ms() -> None:
    """Watchdog 100 ms, commanded velocity zero by 150 ms."""
    pose = Pose(position=np.array((0.3, 0.0, 0.1)), quaternion=np.array((0.0, 1.0, 0.0, 0.0)))
    state = SafetyState.at_rest(pose, PERIOD, RAMP)
    for _ in range(20):
        wish = Pose(position=state.pose.position + 0.1, quaternion=pose.quaternion)
        state = safety_filter(state, Along(pose=wish), LIMITS, 0.0).state
    assert math.hypot(*state.velocity) == pytest.approx(LIMITS.speed)
    periods = 0
    while state.velocity.any():
        state = safety_filter(state, Brake(), LIMITS, 0.0).state
        periods += 1
    assert periods * PERIOD < 0.05


def farthest_turn(seed: int, limits: SafetyLimits) -> float:
    """How far a hand that begins within the limit is ever commanded away from upright, radians."""
    rng = np.random.default_rng(seed)
    upright = np.array((0.0, 1.0, 0.0, 0.0))
    middle = (np.array(limits.box_min) + np.array(limits.box_max)) / 2
    turn = random_turn(rng, 1.0)
    begin = safety.near_turn(upright, quat_multiply(turn, upright), 1.5)
    state = SafetyState.at_rest(Pose(position=middle, quaternion=begin), PERIOD, RAMP)
    axis, farthest = rng.normal(size=3), 0.0
    axis *= limits.step_rotation / np.linalg.norm(axis)
    for i in range(60):
        wish = quat_multiply(quat_from_rotvec(axis + rng.normal(size=3) * 0.02), state.goal.quaternion)
        pose = Pose(position=middle, quaternion=wish)
        target = Target(seq=i, pose=pose, gripper=0.0, created=0.0, expires=1.0)
        state = safety_filter(state, target, limits, 0.0).state
        for _ in range(RAMP):
            state = safety_filter(state, Follow(), limits, 0.0).state
        farthest = max(farthest, *(float(np.linalg.norm(rotation_between(upright, q)))
                                   for q in (state.goal.quaternion, state.pose.quaternion)))  # fmt: skip
    return farthest


@FAST
@given(SEEDS)
def test_the_hand_is_never_wound_up_further_than_the_turn_limit(seed):
    limits = SafetyLimits(box_min=LIMITS.box_min, box_max=LIMITS.box_max, turn=1.5, upright=(0.0, 1.0, 0.0, 0.0))
    assert farthest_turn(seed, limits) <= 1.5 + 0.05  # the servo may swing past its goal by a hair


def test_without_the_turn_limit_it_is():
    assert farthest_turn(0, LIMITS) > 1.6
