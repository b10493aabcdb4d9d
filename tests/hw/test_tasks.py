"""Every task of the paper on both arms: seeded scenes, an expert who solves them within the horizon, a way home."""

import itertools
import math

import numpy as np
import pytest

from far_app.config import TaskConfig
from far_app.demonstrations import demonstrate
from far_app.experts.pick_place import QuarterTurn
from far_app.motion import TargetIntegrator, rotation_between
from far_app.protocols import Heartbeat, Home, Reset
from far_app.tasks import TASKS, at_pace, task
from far_app.types import ACTION_DIM, RobotMode
from hw.lockstep import LockstepRobot
from hw.rig import load_rig
from hw.twin import TwinPlant
from hw.twin_arms import ARMS
from hw.twin_view import TwinView

PANDA = load_rig("panda")


@pytest.mark.parametrize(
    ("name", "panda", "xarm7"),
    [("lift", 100, 150), ("stack", 150, 675), ("door", 200, 900), ("bread", 200, 900), ("can", 200, 300),
     ("square", 200, 300)],
)  # fmt: skip
def test_the_paper_s_horizons_are_kept_in_ticks_and_in_seconds(name, panda, xarm7):
    ours, real = task(name, "panda"), task(name, "xarm7")
    assert (ours.horizon, real.horizon) == (panda, xarm7)
    assert ours.horizon / ours.rate == pytest.approx(real.horizon / real.rate)
    assert ours.rate * ours.repeat == pytest.approx(20.0)
    assert real.rate == 30.0 and real.repeat == 1
    assert at_pace(TASKS[name], "panda") == ours


def test_a_repeated_action_goes_as_far_as_its_repetitions():
    assert PANDA.scale_for(task("stack", "panda")).translation == pytest.approx(3 * PANDA.scale.translation)
    assert PANDA.scale_for(task("lift", "panda")) == PANDA.scale


def solved(robot: LockstepRobot, task: TaskConfig, scene: int) -> bool:
    """Whether the expert succeeds; the arm gets home after it either way."""
    _, _, success = demonstrate(robot, robot.advance, task, robot.scale, scene)
    go_home(robot)
    return success


def go_home(robot: LockstepRobot) -> None:
    robot.request(Home())
    while not robot.observe().status.at_home:
        robot.request(Heartbeat())
        robot.advance()
        status = robot.observe().status
        assert status.mode is not RobotMode.LATCHED, status.reason


@pytest.mark.parametrize("name", sorted(TASKS))
def test_the_twin_s_expert_solves_every_task_within_its_horizon(name):
    entry, rig = task(name), load_rig("twin", name)
    robot = LockstepRobot(TwinPlant(rig, entry), None, rig, entry)
    assert solved(robot, entry, 1_500_000)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(TASKS))
@pytest.mark.parametrize("rig_name", ["panda", "twin"])
def test_the_expert_solves_the_task_and_the_same_seed_gives_the_same_scene(rig_name, name):
    rig = load_rig(rig_name, name)
    entry = task(name, rig.arm)
    plant = TwinPlant(rig, entry)
    first = plant.measure()
    assert first.eef.position == pytest.approx(rig.start_position, abs=0.01)
    assert np.linalg.norm(rotation_between(np.array(rig.start_quaternion), first.eef.quaternion)) < 0.03

    def scene(seed: int) -> np.ndarray:
        plant.reset(seed)
        return np.concatenate([p.position for p in plant.measure().objects.values()])

    assert np.array_equal(scene(3), scene(3))
    assert not np.allclose(scene(3), scene(4), atol=1e-3)
    robot = LockstepRobot(plant, None, rig, entry)
    assert sum(solved(robot, entry, 1_500_000 + i) for i in range(4)) >= 3
    assert set(robot.observe().objects) == {n for n, _ in entry.objects}


@pytest.mark.parametrize(("rig_name", "name"), [("panda", "bread"), ("twin", "can")])
def test_an_arm_that_reached_for_a_far_corner_still_gets_home(rig_name, name):
    """Stretched out, the elbow must not pass its straight line: from beyond it no way home is found."""
    rig = load_rig(rig_name, name)
    entry = task(name, rig.arm)
    robot = LockstepRobot(TwinPlant(rig, entry), None, rig, entry)
    for corner in itertools.product(*zip(rig.safety.box_min, rig.safety.box_max, strict=True)):
        robot.request(Reset(seed=0))
        go_home(robot)
        integrator = TargetIntegrator(robot.scale, robot.observe().eef)
        for _ in range(round(3.0 * entry.rate)):
            eef = robot.observe().eef
            action = np.zeros(ACTION_DIM)
            action[:3] = np.clip((np.array(corner) - eef.position) / robot.scale.translation, -1.0, 1.0)
            robot.send(integrator.target(action, eef, robot.now))
            robot.advance()
            assert robot.observe().joints[3] < ARMS[rig.arm].elbow_stop + 0.05, "the elbow bends the other way"
        go_home(robot)


def test_the_cameras_draw_objects_of_every_mesh_format():
    plant = TwinPlant(load_rig("twin", "can"), task("can"))
    view = TwinView(plant.model_xml(), plant.base_pose(), plant.cameras())
    red, green, blue = np.moveaxis(view.image(plant.snapshot(), "front", 84).astype(int), -1, 0)
    view.close()
    assert ((red > 100) & (green < 50) & (blue < 50)).sum() > 5, "the can is not to be seen"


def test_a_hand_between_near_walls_takes_the_side_that_leaves_room():
    assert QuarterTurn()((0.2, 0.2), 0.1) == pytest.approx(0.1)
    assert abs(math.sin(QuarterTurn()((0.2, 0.05), 0.1))) > 0.9, "along the wall at a small distance in y"
    steady = QuarterTurn()
    assert [steady((0.2, 0.2), yaw) for yaw in (0.7, 0.8, 0.9)] == pytest.approx([0.7, 0.8, 0.9])
