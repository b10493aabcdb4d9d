"""The controller alone: what it commands, tick by tick, to an arm that goes where it is told at once."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from far_app.config import TaskConfig
from far_app.errors import RobotError
from far_app.motion import quat_from_rotvec, quat_multiply, rotation_between
from far_app.protocols import Heartbeat, Hold, Home, Resume
from far_app.tasks import task
from far_app.types import Pose, RobotMode, Target
from hw.controller import BREACH, ArmController
from hw.plant import Measured
from hw.rig import RigConfig, load_rig

RIG, TASK = load_rig("twin"), task("lift")
START = Pose(position=np.array(RIG.start_position), quaternion=np.array(RIG.start_quaternion))


class Arm:
    """A controller, its clock, and an arm that is always where it was last told to be, plus an offset."""

    def __init__(self, servo_hz: int = 120, task: TaskConfig = TASK, rig: RigConfig = RIG) -> None:
        self.servo_hz, self.ticks = servo_hz, 0
        self.offset = np.zeros(3)
        at = Pose(position=np.array(rig.start_position), quaternion=np.array(rig.start_quaternion))
        self.measured = Measured(eef=at, joints=np.zeros(7), gripper=1.0)
        self.controller = ArmController(rig, task, servo_hz, self.measured)
        self.commanded = [at]
        self.gripper = -1.0
        self.seq = 0

    @property
    def now(self) -> float:
        return self.ticks / self.servo_hz

    @property
    def mode(self) -> RobotMode:
        return self.controller.mode

    def tick(self, count: int = 1) -> None:
        for _ in range(count):
            pose, self.gripper = self.controller.tick(self.now, self.measured)
            self.commanded.append(pose)
            opening = self.measured.gripper + np.clip(-self.gripper - self.measured.gripper, -0.02, 0.02)
            eef = Pose(position=pose.position + self.offset, quaternion=pose.quaternion)
            self.measured = replace(self.measured, eef=eef, gripper=float(np.clip(opening, 0, 1)))
            self.ticks += 1

    def target(
        self, step: tuple[float, float, float] = (0.008, 0.0, 0.0), gripper: float = -1.0, turn: float = 0.0
    ) -> str:
        """Offer the next target; returns its refusal."""
        self.seq += 1
        last = self.controller._state.goal if self.mode is RobotMode.TRACKING else self.measured.eef
        turned = quat_multiply(quat_from_rotvec(np.array((0.0, 0.0, turn))), last.quaternion)
        pose = Pose(position=last.position + np.array(step), quaternion=turned)
        return self.controller.offer(
            Target(seq=self.seq, pose=pose, gripper=gripper, created=self.now, expires=self.now + 0.1), self.now
        ).refused

    def stream(self, targets: int) -> None:
        for _ in range(targets):
            assert not self.target()
            self.tick(round(self.servo_hz / TASK.rate))

    def speed(self) -> float:
        return math.dist(self.commanded[-1].position, self.commanded[-2].position) * self.servo_hz

    def beat_until(self, what: Callable[[], bool], limit: float = 30.0) -> None:
        for _ in range(int(limit * self.servo_hz)):
            self.controller.request(Heartbeat(), self.now)
            self.tick()
            if what():
                return
        raise AssertionError(f"it never came to that: {self.controller.status()}")


@pytest.mark.parametrize(("rig", "servo_hz"), [("twin", 120), ("xarm7", 100), ("paper", 100),
                                               ("twin", 250)])  # fmt: skip
def test_the_watchdog_triggers_at_100_ms_and_the_command_stands_still_by_150(rig: str, servo_hz: int) -> None:
    arm = Arm(servo_hz, rig=load_rig(rig))
    for _ in range(12):
        assert not arm.target((0.009, 0.009, 0.0), turn=0.08)  # as fast as any rig lets it
        arm.tick(round(servo_hz / TASK.rate))
    arm.target((0.009, 0.009, 0.0), turn=0.08)
    last = arm.now
    state = arm.controller._state
    assert math.hypot(*state.velocity) > 0.95 * arm.controller.rig.safety.speed or arm.speed() > 0.2
    while arm.mode is RobotMode.TRACKING and arm.now - last < 1.0:
        arm.tick()
    assert 0.1 <= arm.now - last <= 0.1 + 2 / servo_hz
    while arm.controller._state.velocity.any() or arm.controller._state.spin.any():
        arm.tick()
    assert arm.now - last <= 0.150
    assert arm.controller.status().holds == 1


def test_an_arm_whose_report_is_older_than_100_ms_is_held_and_takes_no_target() -> None:
    arm = Arm()
    arm.stream(5)
    arm.measured = replace(arm.measured, age=0.09)
    assert not arm.target()
    arm.tick()
    assert arm.mode is RobotMode.TRACKING
    arm.measured = replace(arm.measured, age=0.11)
    arm.tick()
    assert arm.mode is RobotMode.HOLD and "last report is 110 ms old" in arm.controller.status().reason
    assert "last report is 110 ms old" in arm.target()
    arm.measured = replace(arm.measured, age=0.0)
    arm.tick()
    assert not arm.target(), "and goes on with the next report"


def test_a_stop_at_full_speed_stands_still_within_50_ms() -> None:
    arm = Arm()
    for _ in range(8):
        arm.target((0.012, 0, 0))
        arm.tick(4)
    assert arm.speed() > 0.3
    arm.controller.stop("STOP")
    pressed = arm.now
    assert arm.controller.status().mode is RobotMode.LATCHED, "at once, before any servo tick"
    assert "latched (STOP)" in arm.target()
    arm.tick()
    while arm.speed() > 0:
        arm.tick()
    assert arm.now - pressed < 0.05


def test_motion_after_a_hold_starts_from_the_measured_pose() -> None:
    arm = Arm()
    arm.stream(5)
    arm.tick(40)
    assert arm.mode is RobotMode.HOLD
    arm.measured = replace(
        arm.measured, eef=Pose(position=arm.measured.eef.position + (0, 0.03, 0), quaternion=START.quaternion)
    )
    arm.tick()
    pushed = arm.measured.eef.position + (0, 0.03, 0)
    arm.measured = replace(arm.measured, eef=Pose(position=pushed, quaternion=START.quaternion))
    assert not arm.target()
    arm.tick()
    assert math.dist(arm.commanded[-1].position, pushed) < RIG.safety.speed / arm.servo_hz + 1e-9


@pytest.mark.parametrize("seed", range(20))
def test_no_hold_makes_the_command_of_a_lagging_arm_jump(seed: int) -> None:
    """Holds by silence, however short, on the way and on the way home, requests in the midst of them, STOP and Resume
    in no time, and an arm whose reports stop for a while."""
    arm, rng = Arm(), np.random.default_rng(seed)
    lag = int(rng.integers(1, 13))
    for _ in range(60):
        what = rng.integers(5)
        if arm.mode is RobotMode.LATCHED:
            arm.controller.request(Resume(), arm.now)
        elif what == 2:
            arm.controller.stop("STOP")
        elif what == 0 and arm.mode is not RobotMode.HOMING:
            arm.controller.request(Home(), arm.now)
        elif what == 1:
            arm.controller.request(Hold(reason="pause", latch=False), arm.now)
        silent = rng.random() < 0.1
        for _ in range(int(rng.integers(1, 12))):
            arm.controller.request(Heartbeat(), arm.now)
            arm.target(tuple(rng.normal(size=3) * 0.02), turn=0.05 * rng.normal())
            for _ in range(int(rng.integers(1, 8) if rng.random() < 0.9 else rng.integers(8, 60))):
                seen = arm.measured
                arm.tick()
                now = replace(arm.measured, eef=arm.commanded[max(0, len(arm.commanded) - 1 - lag)], age=0.0)
                silent = silent and seen.age < 0.9
                arm.measured = replace(seen, age=seen.age + 1 / arm.servo_hz) if silent else now
    change = np.diff([p.position for p in arm.commanded], n=2, axis=0) * arm.servo_hz**2
    assert np.linalg.norm(change, axis=1).max() <= RIG.safety.acceleration * (1 + 1e-6)
    spins = [rotation_between(a.quaternion, b.quaternion) for a, b in itertools.pairwise(arm.commanded)]
    change = np.diff(spins, axis=0) * arm.servo_hz**2
    assert np.linalg.norm(change, axis=1).max() <= RIG.safety.rotation_acceleration * (1 + 1e-3)


def test_targets_never_pull_the_command_faster_than_the_limits() -> None:
    arm = Arm()
    rng = np.random.default_rng(0)
    velocity = np.zeros(3)
    for _ in range(200):
        arm.target(tuple(rng.normal(size=3) * 0.02))
        arm.tick(int(rng.integers(1, 8)))
    for before, after in itertools.pairwise(arm.commanded):
        new = (after.position - before.position) * arm.servo_hz
        assert math.hypot(*new) <= RIG.safety.speed + 1e-9
        assert math.dist(new, velocity) <= RIG.safety.acceleration / arm.servo_hz + 1e-9
        velocity = new


def test_sequence_numbers_begin_anew_with_a_home_request() -> None:
    arm = Arm()
    arm.stream(4)
    arm.seq = 0
    assert "out of order" in arm.target()
    arm.controller.request(Home(), arm.now)
    arm.beat_until(lambda: arm.controller.status().at_home)
    arm.seq = 0
    assert not arm.target()


def test_an_arm_error_latches_as_a_fault_and_resume_needs_it_gone() -> None:
    arm = Arm()
    arm.stream(3)
    arm.measured = replace(arm.measured, error="C31: collision caused abnormal current")
    arm.tick()
    status = arm.controller.status()
    assert status.mode is RobotMode.LATCHED
    assert status.fault
    assert "C31" in status.reason
    with pytest.raises(RobotError, match="still reports 'C31"):
        arm.controller.request(Resume(), arm.now)
    arm.measured = replace(arm.measured, error="")
    arm.tick(20)
    assert arm.mode is RobotMode.LATCHED, "errors are never cleared automatically"
    arm.controller.request(Resume(), arm.now)
    assert arm.controller.status() == replace(
        status, mode=RobotMode.HOLD, reason="resumed by the operator", fault=False
    )


def test_a_breach_of_the_workspace_latches_and_after_resume_only_the_way_back_is_open() -> None:
    arm = Arm()
    arm.stream(2)
    low = np.array((RIG.start_position[0], 0.0, RIG.safety.box_max[2] + BREACH + 0.01))
    arm.measured = replace(arm.measured, eef=Pose(position=low, quaternion=START.quaternion))
    arm.tick()
    assert arm.controller.status().fault
    assert "outside the workspace box" in arm.controller.status().reason
    arm.offset = low - arm.commanded[-1].position
    arm.tick(40)  # it has come to rest
    arm.controller.request(Resume(), arm.now)
    arm.offset = np.zeros(3)
    arm.measured = replace(arm.measured, eef=Pose(position=low, quaternion=START.quaternion))
    height = low[2]
    assert not arm.target((0, 0, 0.008))
    arm.tick(4)
    assert arm.measured.eef.position[2] == pytest.approx(height)
    for _ in range(20):
        assert not arm.target((0, 0, -0.008))
        arm.tick(4)
    assert arm.measured.eef.position[2] < RIG.safety.box_max[2]


def test_a_pose_that_is_not_a_number_is_a_fault() -> None:
    arm = Arm()
    arm.stream(2)
    arm.measured = replace(arm.measured, eef=Pose(position=np.full(3, np.nan), quaternion=START.quaternion))
    before = arm.commanded[-1]
    pose, _ = arm.controller.tick(arm.now, arm.measured)
    assert np.isfinite(pose.position).all()
    assert math.dist(pose.position, before.position) < 0.003
    assert arm.controller.status().fault


def away(task: TaskConfig = TASK, gripper: float = 1.0) -> Arm:
    """An arm 15 cm from home, hand closed."""
    arm = Arm(task=task)
    for _ in range(20):
        arm.target((0.004, 0.008, 0.0), gripper)
        arm.tick(4)
    arm.tick(40)
    return arm


def test_home_opens_retreats_and_returns_smoothly() -> None:
    arm = away()
    began, height, first = arm.now, arm.measured.eef.position[2], len(arm.commanded)
    arm.controller.request(Home(), arm.now)
    arm.beat_until(lambda: arm.measured.gripper > 0.95)
    assert arm.measured.eef.position[2] == pytest.approx(height, abs=1e-6), "opens before it moves"
    arm.beat_until(lambda: arm.controller.status().at_home)
    heights = [pose.position[2] for pose in arm.commanded[first:]]
    assert max(heights) == pytest.approx(height + TASK.retreat[2], abs=1e-3)
    assert arm.now - began < 6.0
    assert math.dist(arm.measured.eef.position, START.position) < 1e-3
    speeds = [math.dist(a.position, b.position) * arm.servo_hz for a, b in itertools.pairwise(arm.commanded[first:])]
    assert max(speeds) <= RIG.home.speed * 1.02


def test_the_way_home_passes_through_the_tasks_points_and_goes_on_to_the_next_after_a_hold() -> None:
    path = ((0.05, -0.10, 0.15), (-0.10, -0.10, 0.05))
    arm = away(task=replace(TASK, path=path))
    points = [START.position + np.array(offset) for offset in path]
    first = len(arm.commanded)
    arm.controller.request(Home(), arm.now)
    arm.beat_until(lambda: math.dist(arm.measured.eef.position, points[0]) < 1e-3)
    arm.beat_until(lambda: math.dist(arm.measured.eef.position, points[0]) > 0.05)
    arm.tick(60)
    held, progress = arm.now, list[float]()

    def at_home() -> bool:
        progress.append(arm.controller.status().homing_progress)
        return arm.controller.status().at_home

    arm.beat_until(at_home)
    assert min(np.diff(progress)) >= 0.0, "whoever watches sees it come nearer"
    way = np.array([pose.position for pose in arm.commanded[first:]])
    nearest = [np.linalg.norm(way - point, axis=1) for point in points]
    assert max(distances.min() for distances in nearest) < 1e-3
    assert nearest[0].argmin() < held * arm.servo_hz - first < nearest[1].argmin(), "the first is not visited again"
    assert math.dist(arm.measured.eef.position, START.position) < 1e-3
    speeds = np.linalg.norm(np.diff(way, axis=0), axis=1) * arm.servo_hz
    assert speeds.max() <= RIG.home.speed * 1.02


def test_a_point_on_the_way_home_outside_the_box_is_refused_before_anything_moves() -> None:
    arm = away(task=replace(TASK, path=((0.0, 1.0, 0.0),)))
    with pytest.raises(RobotError, match="the path home leaves the workspace box"):
        arm.controller.request(Home(), arm.now)
    assert arm.mode is not RobotMode.HOMING


def test_homing_at_home_with_an_open_hand_takes_no_detour() -> None:
    arm = Arm()
    arm.controller.request(Home(), arm.now)
    arm.beat_until(lambda: arm.controller.status().at_home)
    assert arm.now < 0.5
    assert max(pose.position[2] for pose in arm.commanded) == pytest.approx(START.position[2], abs=1e-6)


def test_an_arm_that_does_not_get_home_is_a_fault_that_says_how_far_off() -> None:
    arm = away()
    arm.controller.request(Home(), arm.now)
    arm.offset = np.array((0.02, 0, 0))
    arm.beat_until(lambda: arm.mode is RobotMode.LATCHED)
    status = arm.controller.status()
    assert status.fault
    assert not status.at_home
    assert "20 mm" in status.reason


def test_homing_waits_for_the_operator_when_the_task_says_ask() -> None:
    arm = away(task=replace(TASK, release="ask"))
    arm.controller.request(Home(), arm.now)
    arm.beat_until(lambda: arm.now > 3.0)
    assert arm.mode is RobotMode.HOMING
    assert "take what the hand holds" in arm.controller.status().reason
    assert arm.gripper == 1.0
    arm.controller.request(Resume(), arm.now)
    arm.beat_until(lambda: arm.controller.status().at_home)
    assert arm.gripper == -1.0


def test_lower_then_open_goes_down_before_it_lets_go() -> None:
    arm = away(task=replace(TASK, release="lower_then_open"))
    height = arm.measured.eef.position[2]
    arm.controller.request(Home(), arm.now)
    arm.beat_until(lambda: arm.gripper < 0)
    assert arm.measured.eef.position[2] < height - 0.05
    assert arm.measured.eef.position[2] >= RIG.safety.box_min[2]


def test_a_hold_ends_homing_and_a_latch_too() -> None:
    for hold in (Hold(reason="operator"), Hold(reason="operator", latch=True)):
        arm = away()
        arm.controller.request(Home(), arm.now)
        arm.beat_until(lambda arm=arm: arm.controller.status().homing_progress > 0.3)
        arm.controller.request(hold, arm.now)
        arm.tick(30)
        assert arm.speed() == 0.0
        arm.controller.request(Heartbeat(), arm.now)
        arm.tick(30)
        assert arm.speed() == 0.0
        assert not arm.controller.status().at_home


def test_resume_does_not_swallow_a_stop_that_is_on_its_way() -> None:
    arm = Arm()
    arm.controller.stop("STOP")
    with pytest.raises(RobotError, match="resume again"):
        arm.controller.request(Resume(), arm.now)
    arm.tick()
    assert arm.mode is RobotMode.LATCHED
