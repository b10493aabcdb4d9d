"""What every Robot promises: the twin in lockstep and in its server, a real arm's driver on the fake controller."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from far_app.errors import RobotError
from far_app.motion import TargetIntegrator, rotation_between
from far_app.protocols import Heartbeat, Hold, Home, Reset, Resume, Robot
from far_app.types import Pose, RobotMode
from tests.hw.conftest import TASK, Bench

FORWARD = np.array((0.5, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0))
TICK = 1 / TASK.rate


def positions(objects: dict[str, Pose]) -> np.ndarray:
    return np.array([pose.position for _, pose in sorted(objects.items())])


def test_it_is_a_robot(bench: Bench) -> None:
    assert isinstance(bench.robot, Robot)


def test_an_observation_is_whole(bench: Bench) -> None:
    observation = bench.start(seed=1)
    assert set(observation.images) == set(bench.cameras)
    for image in observation.images.values():
        assert image.shape == (bench.rig.policy_image, bench.rig.policy_image, 3)
        assert image.dtype == np.uint8
        assert image.std() > 5, "an empty picture"
    assert observation.joints.shape == (7,)
    assert abs(float(np.linalg.norm(observation.eef.quaternion)) - 1) < 1e-6
    assert observation.status.scene_seed == 1
    assert observation.success is (False if bench.cameras else None), "only a twin can tell"
    assert 0 <= observation.reward <= 1
    later = bench.until(lambda o: o.stamp > observation.stamp)
    assert later.seq > observation.seq
    assert 0 <= bench.now() - later.stamp < 1


def test_the_same_seed_gives_the_same_scene_and_another_seed_another(twin_bench: Bench) -> None:
    first = positions(dict(twin_bench.start(seed=11).objects))
    other = positions(dict(twin_bench.start(seed=12).objects))
    again = positions(dict(twin_bench.start(seed=11).objects))
    np.testing.assert_allclose(again, first, atol=1e-4)
    assert np.abs(other - first).max() > 0.005


def test_a_reset_puts_the_arm_at_its_start_pose(bench: Bench) -> None:
    bench.start(seed=1)
    bench.drive(FORWARD, 15)
    eef = bench.start(seed=1).eef
    assert math.dist(eef.position, bench.rig.start_position) < bench.rig.home.tolerance_translation


def test_targets_are_followed_promptly(bench: Bench) -> None:
    start = bench.start(seed=1).eef
    reached = bench.drive(FORWARD, 24)[-1]
    moved = reached.eef.position - start.position
    assert 0.065 < moved[0] < 0.10, "24 ticks of 4 mm, less the arm's lag"
    assert np.abs(moved[1:]).max() < 0.01
    assert reached.status.mode is RobotMode.TRACKING
    assert not [ack for ack in bench.acks if ack.refused]


def test_the_gripper_follows(bench: Bench) -> None:
    assert bench.start(seed=1).gripper > 0.9
    closing = np.array((0, 0, 0.2, 0, 0, 0, 1.0))
    assert bench.drive(closing, 25)[-1].gripper < 0.2
    assert bench.go_home().gripper > 0.9


def test_every_target_is_acknowledged_once_with_what_was_sent(bench: Bench) -> None:
    bench.start(seed=1)
    bench.drive(np.array((0.4, 0.3, 0.2, 0.1, 0.0, -0.2, 0.5)), 30)
    bench.ack(bench.sent[-1])
    assert [ack.seq for ack in bench.acks] == bench.sent
    for before, after in itertools.pairwise(bench.acks):
        assert math.dist(before.pose.position, after.pose.position) <= bench.rig.safety.step_translation + 1e-9
        assert after.gripper == 0.5
        assert after.accepted >= before.accepted


def test_a_step_beyond_the_limit_is_clipped_and_told(bench: Bench) -> None:
    observation = bench.start(seed=1)
    target = TargetIntegrator(bench.rig.scale, observation.eef).target(FORWARD, observation.eef, bench.now())
    leap = Pose(position=target.pose.position + np.array((0, 0.2, 0)), quaternion=target.pose.quaternion)
    clips = observation.status.clips
    bench.send(replace(target, pose=leap))
    ack = bench.ack(target.seq)
    assert ack.clipped
    assert not ack.refused
    assert math.dist(ack.pose.position, observation.eef.position) < bench.rig.safety.step_translation + 0.002
    assert bench.until(lambda o: o.status.clips > clips).status.clips == clips + 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"expires": -1.0}, "expired"),
        ({"gripper": math.nan}, "not a finite number"),
        ({"pose": Pose(position=np.full(3, np.nan), quaternion=np.array((0, 1.0, 0, 0)))}, "not a finite number"),
    ],
)
def test_bad_targets_are_refused_with_words_and_nothing_moves(bench: Bench, change: dict, words: str) -> None:
    observation = bench.start(seed=1)
    target = TargetIntegrator(bench.rig.scale, observation.eef).target(FORWARD, observation.eef, bench.now())
    bench.send(replace(target, **change))
    assert words in bench.ack(target.seq).refused
    for _ in range(3):
        bench.tick()
    after = bench.observe()
    assert after.status.mode is RobotMode.HOLD
    assert math.dist(after.eef.position, observation.eef.position) < 0.002


def test_duplicated_and_reordered_targets_are_refused(bench: Bench) -> None:
    observation = bench.start(seed=1)
    integrator = TargetIntegrator(bench.rig.scale, observation.eef)
    older = integrator.target(FORWARD, observation.eef, bench.now())
    newer = integrator.target(FORWARD, observation.eef, bench.now())
    for target in (newer, older, newer):
        bench.send(target)
    bench.until(lambda o: len(bench.acks) == 3)
    assert [bool(ack.refused) for ack in bench.acks] == [False, True, True]
    assert "out of order or sent twice" in bench.acks[1].refused


def test_without_fresh_targets_the_arm_is_held_and_resumes_without_a_jump(bench: Bench) -> None:
    bench.start(seed=1)
    holds = bench.drive(FORWARD, 12)[-1].status.holds
    bench.until(lambda o: o.status.mode is RobotMode.HOLD)
    for _ in range(10):
        bench.tick()
    held = bench.observe()
    assert held.status.holds > holds
    assert "no fresh target for 100 ms" in held.status.reason
    bench.tick()
    assert math.dist(bench.observe().eef.position, held.eef.position) < 0.002, "still"
    bench.sent.clear()
    observations = [held, *bench.drive(FORWARD, 8)]
    first = bench.ack(bench.sent[0])
    assert math.dist(first.pose.position, held.eef.position) < bench.rig.safety.step_translation + 0.002
    assert observations[-1].status.mode is RobotMode.TRACKING
    for before, after in itertools.pairwise(observations):
        ticks = max(1.0, (after.stamp - before.stamp) / TICK)
        assert math.dist(before.eef.position, after.eef.position) < 1.5 * bench.rig.safety.speed * TICK * ticks


def test_homing_leaves_the_objects_and_ends_at_the_start_pose(bench: Bench) -> None:
    before = bench.start(seed=3)
    bench.drive(np.array((0.5, 0.8, 0.2, 0.0, 0.2, 0.8, 1.0)), 25)
    assert not bench.observe().status.at_home
    home = bench.go_home()
    assert home.status.at_home
    assert home.status.mode is RobotMode.HOLD
    if before.objects:
        np.testing.assert_allclose(positions(dict(home.objects)), positions(dict(before.objects)), atol=1e-3)
    assert math.dist(home.eef.position, bench.rig.start_position) < bench.rig.home.tolerance_translation
    turn = rotation_between(home.eef.quaternion, np.array(bench.rig.start_quaternion))
    assert float(np.linalg.norm(turn)) < bench.rig.home.tolerance_rotation
    assert home.gripper > 0.9
    for _ in range(3):
        bench.tick()
    assert math.dist(bench.observe().eef.position, home.eef.position) < 0.002, "settled"


def test_homing_refuses_targets_and_stands_still_without_heartbeats(bench: Bench) -> None:
    observation = bench.start(seed=3)
    bench.drive(np.array((0.5, 0.8, 0.2, 0.0, 0.0, 0.0, -1.0)), 25)
    bench.robot.request(Home())
    bench.send(TargetIntegrator(bench.rig.scale, observation.eef).target(FORWARD, observation.eef, bench.now()))
    assert "going home" in bench.ack(bench.sent[-1]).refused
    bench.until(lambda o: "no heartbeat for 100 ms" in o.status.reason)
    for _ in range(10):
        bench.tick()
    stuck = bench.observe()
    assert stuck.status.mode is RobotMode.HOMING
    bench.tick()
    assert math.dist(bench.observe().eef.position, stuck.eef.position) < 0.001
    for _ in range(300):
        bench.robot.request(Heartbeat())
        bench.tick()
        if bench.observe().status.at_home:
            return
    raise AssertionError(f"homing did not go on: {bench.observe().status}")


def test_a_hold_stops_and_a_target_goes_on(bench: Bench) -> None:
    bench.start(seed=1)
    bench.drive(FORWARD, 10)
    bench.robot.request(Hold(reason="paused by the operator"))
    for _ in range(10):
        bench.tick()
    held = bench.observe()
    assert held.status.mode is RobotMode.HOLD
    assert held.status.reason == "paused by the operator"
    assert bench.drive(FORWARD, 3)[-1].status.mode is RobotMode.TRACKING


def test_a_latch_refuses_everything_but_resume(bench: Bench) -> None:
    bench.start(seed=1)
    bench.drive(FORWARD, 10)
    bench.robot.request(Hold(reason="STOP", latch=True))
    bench.sent.clear()
    latched = bench.drive(FORWARD, 12)[-1]
    assert latched.status.mode is RobotMode.LATCHED
    assert not latched.status.fault
    assert latched.status.reason == "STOP"
    assert all("latched (STOP); resume first" in bench.ack(seq).refused for seq in bench.sent)
    with pytest.raises(RobotError, match=r"Home refused: the arm is latched \(STOP\)"):
        bench.robot.request(Home())
    with pytest.raises(RobotError, match="Reset refused"):
        bench.robot.request(Reset(seed=1))
    bench.tick()
    assert math.dist(bench.observe().eef.position, latched.eef.position) < 0.002, "still"
    bench.robot.request(Resume())
    assert bench.robot.observe().status.mode is RobotMode.HOLD
    assert bench.drive(FORWARD, 4)[-1].status.mode is RobotMode.TRACKING


def test_near_the_wall_of_the_box_the_arm_stays_inside(bench: Bench) -> None:
    bench.start(seed=1)
    up = np.array((0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0))
    ticks = int((bench.rig.safety.box_max[2] - bench.rig.start_position[2]) / bench.rig.scale.translation) + 20
    top = bench.drive(up, ticks)[-1]
    assert max(ack.pose.position[2] for ack in bench.acks) <= bench.rig.safety.box_max[2]
    assert top.eef.position[2] < bench.rig.safety.box_max[2] + 0.01
    assert top.status.mode is RobotMode.TRACKING
    assert top.status.clips > 0
