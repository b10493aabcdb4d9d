"""An arm that a person leads by hand: the controller's rules alone, then the vendor's SDK against a fake."""

from __future__ import annotations

import itertools
import time
from dataclasses import replace

import numpy as np
import pytest

from far_app.errors import RobotError
from far_app.protocols import Guide, Heartbeat, Hold, Home, Resume
from far_app.types import Pose, RobotMode, Target
from hw.controller import ArmController
from hw.fake_xarm.control import FakeXArm
from hw.lockstep import LockstepRobot
from hw.plant import Measured
from hw.rig import at_address
from hw.xarm7.plant import XArmPlant
from tests.hw.conftest import FAKE_PORT, RIG, TASK, XARM, loopback

HERE = Pose(position=np.array(RIG.start_position), quaternion=np.array(RIG.start_quaternion))
T = 1.0 / 120.0


def measured(x: float = 0.0) -> Measured:
    return Measured(
        eef=replace(HERE, position=HERE.position + (x, 0.0, 0.0)), joints=np.zeros(7), gripper=1.0
    )  # fmt: skip


@pytest.fixture
def led():
    controller = ArmController(RIG, TASK, 120, measured())
    controller.request(Guide(on=True, gripper=1.0), 0.0)
    return controller


def target(seq: int, now: float) -> Target:
    return Target(seq=seq, pose=HERE, gripper=0.0, created=now, expires=now + 0.1, due=now)


def test_a_led_arm_takes_no_target_and_its_command_is_where_the_person_has_it(led):
    assert led.mode is RobotMode.GUIDED
    assert "led by hand" in led.offer(target(1, 0.01), 0.01).refused
    for k in range(10):
        led.request(Heartbeat(), k * T)
        pose, gripper = led.tick(k * T, measured(0.001 * k))
        assert np.allclose(pose.position, measured(0.001 * k).eef.position) and gripper == 1.0


def test_without_heartbeats_it_is_held_where_it_is(led):
    ticks = itertools.count()
    while led.mode is RobotMode.GUIDED:
        k = next(ticks)
        assert k * T < 2 * RIG.watchdog, "it was never held"
        led.tick(k * T, measured(0.0005 * k))
    assert led.mode is RobotMode.HOLD and "led by hand" in led.reason and led.holds == 1


def test_motion_afterwards_starts_from_where_the_person_left_it(led):
    led.request(Heartbeat(), 0.05)
    led.tick(0.05, measured(0.03))
    led.request(Guide(on=False), 0.06)
    assert led.mode is RobotMode.HOLD
    ack = led.offer(target(1, 0.06), 0.06)
    assert not ack.refused
    pose, _ = led.tick(0.07, measured(0.03))
    assert np.linalg.norm(pose.position - measured(0.03).eef.position) < 0.003


@pytest.mark.parametrize("before", [Home(), Hold(reason="STOP", latch=True)])
def test_it_cannot_be_led_on_its_way_home_nor_while_latched(before):
    controller = ArmController(RIG, TASK, 120, measured())
    controller.request(before, 0.0)
    with pytest.raises(RobotError, match="Guide refused"):
        controller.request(Guide(on=True), 0.01)


def test_stop_and_home_end_it(led):
    led.request(Home(), 0.01)
    assert led.mode is RobotMode.HOMING
    led.request(Hold(reason="enough"), 0.02)
    led.request(Guide(on=True), 0.03)
    led.stop("STOP")
    led.tick(0.04, measured())
    assert led.mode is RobotMode.LATCHED


def test_the_twin_says_that_it_cannot_be_led():
    from hw.twin import TwinPlant

    robot = LockstepRobot(TwinPlant(RIG, TASK), None, RIG, TASK)
    with pytest.raises(RobotError, match="teleop"):
        robot.request(Guide(on=True))
    assert robot.observe().status.mode is RobotMode.HOLD


# ── the vendor's SDK ──


@pytest.fixture
def arm():
    address = loopback()
    fake = FakeXArm.start(address, FAKE_PORT)
    plant = XArmPlant(at_address(XARM, f"{address}:{FAKE_PORT}"), TASK)
    yield fake, plant
    plant.close()
    fake.close()


def reported(plant: XArmPlant, x: float) -> bool:
    end = time.monotonic() + 3
    while time.monotonic() < end:
        if abs(plant.measure().eef.position[0] - x) < 1e-6:
            return True
        time.sleep(0.005)
    return False


def test_an_xarm_gives_way_in_manual_mode_and_only_there(arm):
    fake, plant = arm
    assert not fake.lead(10, 0, 0), "in servo mode it is stiff"
    plant.guide(True)
    assert fake.state()["mode"] == 2 and plant.guided
    x = plant.measure().eef.position[0]
    assert fake.lead(10, 0, 0) and reported(plant, x + 0.010)
    fake.received()
    plant.servo(HERE, 1.0)
    assert fake.servo_targets() == [], "nothing is commanded meanwhile"
    plant.guide(False)
    assert fake.state()["mode"] == 1 and not plant.guided
    primes = fake.servo_targets()
    assert primes and all(abs(p["pose"][0] - 1e3 * (x + 0.010)) < 0.01 for p in primes), "stiff where it stands"
    assert not fake.lead(10, 0, 0)
    assert plant.measure().error == ""


def test_stop_ends_leading_and_only_resume_makes_the_arm_ready_again(arm):
    fake, plant = arm
    plant.guide(True)
    plant.halt()
    end = time.monotonic() + 3
    while fake.state()["state"] != 4:
        assert time.monotonic() < end, "STOP did not reach the controller"
        time.sleep(0.005)
    assert not fake.lead(10, 0, 0)
    plant.guide(False)
    assert fake.state()["mode"] == 2, "a stopped arm is not made ready by itself"
    with pytest.raises(RobotError, match="stopped"):
        plant.guide(True)
    plant.rearm()
    assert fake.state()["mode"] == 1 and not plant.guided


def test_an_arm_that_leaves_its_manual_mode_by_itself_is_a_fault(arm):
    fake, plant = arm
    plant.guide(True)
    fake.tell(do="set", name="mode", value=0)
    end = time.monotonic() + 3
    while not plant.measure().error:
        assert time.monotonic() < end
        time.sleep(0.005)
    assert "manual mode" in plant.measure().error


def test_resume_is_a_request_of_its_own():
    controller = ArmController(RIG, TASK, 120, measured())
    controller.request(Guide(on=True), 0.0)
    controller.request(Resume(), 0.01)
    assert controller.mode is RobotMode.GUIDED, "there is nothing to resume from"
