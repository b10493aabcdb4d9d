"""The twin itself: exact time, seeded scenes, a solvable task, pictures that show it."""

import mujoco
import numpy as np
import pytest

from far_app.demonstrations import demonstrate
from far_app.motion import TargetIntegrator, rotation_between
from far_app.protocols import Hold, Reset
from far_app.tasks import task
from far_app.types import Pose, RobotMode
from hw.lockstep import LockstepRobot
from hw.rig import load_rig
from hw.twin import SERVO_HZ, TwinPlant
from hw.twin_arms import ARMS
from hw.twin_view import TwinView, look_at

RIG, TASK = load_rig("twin"), task("lift")


@pytest.fixture(scope="module")
def plant() -> TwinPlant:
    return TwinPlant(RIG, TASK)


@pytest.fixture(scope="module")
def view(plant: TwinPlant):
    view = TwinView(plant.model_xml(), plant.base_pose(), plant.cameras())
    yield view
    view.close()


def test_a_servo_tick_is_exactly_one_hundred_and_twentieth_of_a_second(plant):
    before = plant.data.time
    for _ in range(SERVO_HZ):
        plant.advance()
    assert plant.data.time - before == pytest.approx(1.0, abs=1e-9)


def test_scenes_come_from_seeds_and_spread_wide(plant):
    def cube(seed):
        plant.reset(seed)
        return plant.measure().objects["cube"]

    assert np.array_equal(cube(3).position, cube(3).position)
    cubes = [cube(seed) for seed in range(30)]
    spread = np.ptp([c.position[:2] for c in cubes], axis=0)
    assert np.all(spread > 0.15)
    yaws = [np.arctan2(c.quaternion[2], c.quaternion[3]) for c in cubes]
    assert np.ptp(yaws) > 1.5


def test_two_twins_of_a_task_are_the_same(plant):
    other = TwinPlant(RIG, TASK)
    assert np.array_equal(other.model.geom_size, plant.model.geom_size)
    for one in (plant, other):
        one.reset(7)
    assert np.array_equal(other.data.qpos, plant.data.qpos)


def test_the_arm_starts_at_the_rig_s_start_pose(plant):
    plant.reset(0)
    eef = plant.measure().eef
    assert eef.position == pytest.approx(RIG.start_position, abs=0.005)
    assert np.linalg.norm(rotation_between(np.array(RIG.start_quaternion), eef.quaternion)) < 0.02


def test_world_and_base_frame_are_inverse(plant):
    pose = Pose(position=np.array([0.3, -0.2, 0.4]), quaternion=np.array([0.5, 0.5, -0.5, 0.5]))
    world = plant.to_world(pose)
    again = plant.to_base(world.position, world.quaternion)
    assert np.allclose(again.position, pose.position)
    assert np.allclose(again.quaternion, pose.quaternion)


def test_a_commanded_pose_is_reached(plant):
    plant.reset(0)
    goal = Pose(position=np.array([0.55, 0.05, 0.05]), quaternion=np.array(RIG.start_quaternion))
    for _ in range(2 * SERVO_HZ):
        plant.servo(goal, 1.0)
        plant.advance()
    measured = plant.measure()
    assert measured.eef.position == pytest.approx(goal.position, abs=0.003)
    assert measured.gripper < 0.1


def test_freeing_a_latched_arm_puts_it_at_its_start_pose_and_leaves_the_objects(plant):
    robot = LockstepRobot(plant, None, RIG, TASK)
    robot.request(Reset(seed=3))
    start, cube = robot.observe().eef, robot.observe().objects["cube"]
    integrator = TargetIntegrator(RIG.scale, start)
    for _ in range(20):
        robot.send(integrator.target(np.array([0, 0.5, 0.2, 0, 0, 0, 1.0]), robot.observe().eef, robot.now))
        robot.advance()
    assert not robot.free(), "there is nothing to free"
    robot.request(Hold(reason="caught", latch=True))
    assert robot.free()
    freed = robot.observe()
    assert freed.status.mode is RobotMode.HOMING and freed.gripper > 0.95
    assert freed.eef.position == pytest.approx(start.position, abs=0.003)
    assert freed.objects["cube"].position == pytest.approx(cube.position, abs=0.002)


@pytest.mark.slow
def test_the_expert_lifts_the_cube_and_no_two_demonstrations_are_copies(plant):
    robot = LockstepRobot(plant, None, RIG, TASK)
    runs = [demonstrate(robot, robot.advance, TASK, RIG.scale, 1_000_000 + i) for i in range(6)]
    assert all(success for _, _, success in runs)
    lengths = [len(actions) for _, actions, _ in runs]
    assert max(lengths) < TASK.horizon
    assert all(np.all(np.abs(actions) <= 1.0) for _, actions, _ in runs)
    assert len({round(float(actions[0][0]), 6) for _, actions, _ in runs}) == len(runs)


def test_pictures_show_the_cube_where_it_is(plant, view):
    plant.reset(1)

    def red(camera, size=84):
        image = view.image(plant.snapshot(), camera, size).astype(int)
        mask = (image[..., 0] > 90) & (image[..., 1] < 80) & (image[..., 2] < 90)
        return np.argwhere(mask)

    plant.reset(1)
    first = red("front")
    assert len(first) > 5
    assert len(red("wrist")) > 5
    seed = next(s for s in range(2, 20) if moved(plant, 1, s) > 0.1)
    plant.reset(seed)
    assert np.linalg.norm(red("front").mean(0) - first.mean(0)) > 3


def moved(plant, one, other):
    positions = []
    for seed in (one, other):
        plant.reset(seed)
        positions.append(plant.measure().objects["cube"].position)
    return float(np.linalg.norm(positions[0] - positions[1]))


def test_every_size_shows_the_same_scene(plant, view):
    plant.reset(2)
    small = view.image(plant.snapshot(), "front", 84).astype(float)
    large = view.image(plant.snapshot(), "front", 168).astype(float)
    shrunk = large.reshape(84, 2, 84, 2, 3).mean((1, 3))
    assert np.abs(shrunk - small).mean() < 6.0


def test_geometry_belongs_to_bodies_that_have_poses(plant, view):
    geometry = view.geometry()
    poses = view.body_poses(plant.snapshot())
    assert len(geometry.meshes) > 10
    assert all(0 <= m.body < len(poses) and m.faces.max() < len(m.vertices) for m in geometry.meshes)
    assert poses[list(geometry.body_names).index("robot0_base"), :3] == pytest.approx([0, 0, 0], abs=1e-9)
    cube = list(geometry.body_names).index("cube_main")
    assert poses[cube, :3] == pytest.approx(plant.measure().objects["cube"].position, abs=1e-6)


def test_cameras_look_at_their_targets(plant):
    import mujoco

    for camera in (plant.cameras()["front"], *(arm.wrist for arm in ARMS.values())):
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, look_at(camera))
        forward = -matrix.reshape(3, 3)[:, 2]
        wanted = np.subtract(camera.target, camera.position)
        assert forward == pytest.approx(wanted / np.linalg.norm(wanted))


@pytest.mark.parametrize("rig,name", [("twin", "lift"), ("twin", "door"), ("panda", "can"), ("panda", "square")])
def test_what_is_left_out_of_a_drawing_is_not_to_be_seen_in_it(rig, name, monkeypatch):
    """Geoms beside and behind a camera, and the sky: pictures without them are the same to the last grey level."""
    rig = load_rig(rig, name)
    plant = TwinPlant(rig, task(name, rig.arm))
    view = TwinView(plant.model_xml(), plant.base_pose(), plant.cameras())
    left_out = 0
    for seed in range(3):
        plant.reset(seed)
        for _ in range(30 * seed):
            plant.servo(plant.measure().eef, 1.0)
            plant.advance()
        for camera in plant.cameras():
            picture = view.image(plant.snapshot(), camera, 84)
            left_out += int((~view._in_sight(camera)).sum())
            with monkeypatch.context() as patched:
                patched.setattr(TwinView, "_in_sight", lambda self, camera: np.ones(self._visual.sum(), bool))
                view._renderer(84).scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 1
                assert np.array_equal(view.image(plant.snapshot(), camera, 84), picture)
                view._renderer(84).scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 0
    view.close()
    assert left_out > 10
