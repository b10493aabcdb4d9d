"""The server's threads around a plant of another kind (100 Hz, no physics), and what a dying plant or camera does."""

from __future__ import annotations

import math
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq

from far_app.endpoints import Endpoints
from far_app.errors import RobotError
from far_app.link import RemoteRobot
from far_app.protocols import Hold, Resume
from far_app.station import Station
from far_app.tasks import task
from far_app.telemetry import SceneGeometry
from far_app.types import Ack, Pose, RobotMode, RobotStatus, Target
from hw.camera_thread import CameraThread, Pictures
from hw.command_thread import CommandThread
from hw.controller import ArmController
from hw.picture_timing import PictureTiming
from hw.plant import Measured
from hw.publisher_thread import PublisherThread
from hw.rig import load_rig
from hw.servo_thread import ServoThread

RIG, TASK = load_rig("twin"), task("lift")


class KinematicPlant:
    """An arm that is where it was told to be, at the rate of the real one."""

    servo_hz = 100
    guided = False

    def __init__(self) -> None:
        self.pose = Pose(position=np.array(RIG.start_position), quaternion=np.array(RIG.start_quaternion))
        self.breaks: Exception | None = None
        self.stuck = threading.Event()
        self.stuck.set()
        self.halts = self.rearmed = 0

    def measure(self) -> Measured:
        return Measured(eef=self.pose, joints=np.zeros(7), gripper=1.0)

    def servo(self, pose: Pose, gripper: float) -> None:
        self.pose = pose

    def advance(self) -> None:
        self.stuck.wait()
        if self.breaks is not None:
            raise self.breaks

    def reset(self, seed: int) -> None:
        raise RobotError("an arm cannot reset the scene; the operator does")

    def halt(self) -> None:
        self.halts += 1

    def rearm(self) -> bool:
        self.rearmed += 1
        return True

    def close(self) -> None: ...

    def snapshot(self) -> Any:
        return self.pose


class BlindView:
    """Draws grey until it breaks."""

    def __init__(self, good: int) -> None:
        self.good = good

    def image(self, snapshot: Any, camera: str, size: int) -> np.ndarray:
        self.good -= 1
        if self.good < 0:
            raise OSError("the context was lost")
        return np.full((size, size, 3), 128, np.uint8)

    def body_poses(self, snapshot: Any) -> np.ndarray:
        return np.zeros((1, 7))

    def geometry(self) -> SceneGeometry:
        return SceneGeometry(meshes=(), body_names=("base",))

    def close(self) -> None:
        pass


@pytest.fixture
def plant() -> KinematicPlant:
    return KinematicPlant()


@pytest.fixture
def servo(plant: KinematicPlant) -> Iterator[ServoThread]:
    thread = ServoThread(plant, ArmController(RIG, TASK, plant.servo_hz, plant.measure()), camera_rate=TASK.rate)
    thread.start()
    yield thread
    plant.stuck.set()
    thread.close()


def wait_for(servo: ServoThread, what: Callable[[RobotStatus], bool], limit: float = 5.0) -> RobotStatus:
    deadline = time.monotonic() + limit
    while time.monotonic() < deadline:
        with servo.locked() as controller:
            status = controller.status()
        if what(status):
            return status
        time.sleep(0.01)
    raise AssertionError(f"it never came to that: {status}")


def test_a_plant_that_breaks_is_a_fault_in_its_own_words(servo: ServoThread, plant: KinematicPlant) -> None:
    plant.breaks = OSError("the controller closed the connection")
    status = wait_for(servo, lambda s: s.fault)
    assert status.mode is RobotMode.LATCHED
    assert "the controller closed the connection" in status.reason


def test_stop_is_told_at_once_while_the_plant_hangs(servo: ServoThread, plant: KinematicPlant) -> None:
    plant.stuck.clear()
    time.sleep(0.05)
    servo.stop("STOP")
    assert plant.halts == 1, "the arm's own stop does not wait for the servo thread"
    with servo.locked() as controller:
        assert controller.status().mode is RobotMode.LATCHED
    plant.stuck.set()
    wait_for(servo, lambda s: s.mode is RobotMode.LATCHED and s.reason == "STOP")


def test_a_reset_that_the_plant_refuses_is_refused_in_its_words(servo: ServoThread) -> None:
    with pytest.raises(RobotError, match="the operator does"):
        servo.reset(1).result(timeout=5)
    assert servo.alive


def test_the_servo_thread_keeps_its_rate_and_never_bursts(servo: ServoThread, plant: KinematicPlant) -> None:
    time.sleep(0.3)
    before = servo.ticks
    plant.stuck.clear()
    time.sleep(0.5)
    plant.stuck.set()
    stalled = servo.ticks
    assert stalled - before <= 2
    began = time.monotonic()
    time.sleep(0.3)
    assert servo.ticks - stalled <= (time.monotonic() - began) * plant.servo_hz + 2, "missed ticks are not made up for"
    assert servo.re_anchored >= 1


def test_a_lost_camera_is_a_fault_in_its_own_words(servo: ServoThread) -> None:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    endpoints = Endpoints.in_folder(Path(tempfile.mkdtemp(prefix="far-hw-")))
    pictures: list[Pictures] = []

    def lost(reason: str) -> None:
        with servo.locked() as controller:
            controller.fail(reason)

    cameras = CameraThread(lambda: BlindView(good=12), RIG, TASK, servo, context, endpoints.view, pictures.append, lost)
    cameras.start()
    status = wait_for(servo, lambda s: s.fault)
    assert "the context was lost" in status.reason
    assert len(pictures) >= 3
    assert set(pictures[-1].images) == set(TASK.cameras)
    cameras.close()
    context.destroy(linger=0)


@pytest.fixture
def line(servo: ServoThread) -> Iterator[RemoteRobot]:
    """To the servo thread, by way of the threads that serve it."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    endpoints = Endpoints.in_folder(Path(tempfile.mkdtemp(prefix="far-hw-")))
    publisher = PublisherThread(servo, context, endpoints.observations, TASK.rate)
    timing = PictureTiming(1 / 100, 1 / TASK.rate)
    commands = CommandThread(servo, publisher, lambda: None, timing, context, endpoints, Station(rig={}, task="lift"))
    publisher.start()
    commands.start()
    link = RemoteRobot(endpoints)
    yield link
    link.close()
    commands.close()
    publisher.close()
    context.destroy(linger=0)


def target(seq: int, early: float) -> Target:
    pose = Pose(position=np.array(RIG.start_position), quaternion=np.array(RIG.start_quaternion))
    now = time.monotonic()
    return Target(seq=seq, pose=pose, gripper=-1.0, created=now, expires=now + 5.0, due=now + early)


def acknowledged(link: RemoteRobot, count: int) -> list[Ack]:
    deadline, acks = time.monotonic() + 5.0, []
    while len(acks) < count and time.monotonic() < deadline:
        acks += link.observe().acks
        time.sleep(0.002)
    return acks


def test_a_target_that_comes_early_waits_for_its_moment(line: RemoteRobot) -> None:
    for seq in range(1, 31):
        line.send(target(seq, early=0.0015 * (seq % 10)))
        time.sleep(0.02)
    acks = acknowledged(line, 30)
    assert [a.seq for a in acks] == list(range(1, 31))
    assert not any(a.refused for a in acks)
    assert all(a.accepted >= a.due for a in acks)


@pytest.mark.parametrize("early", [math.nan, 3600.0])
def test_one_without_a_moment_or_with_one_far_off_is_taken_at_once(line: RemoteRobot, early: float) -> None:
    sent = target(1, early)
    line.send(sent)
    (ack,) = acknowledged(line, 1)
    assert ack.accepted < sent.created + 1.0
    assert not ack.refused


def test_what_comes_after_an_early_target_finds_it_admitted(line: RemoteRobot, servo: ServoThread) -> None:
    line.send(target(1, early=0.015))
    line.send(target(2, early=0.015))
    line.request(Hold(reason="enough"))
    first, second = acknowledged(line, 2)
    assert (first.seq, second.seq, first.refused, second.refused) == (1, 2, "", "")
    time.sleep(0.05)
    with servo.locked() as controller:
        assert controller.status().mode is RobotMode.HOLD, "no target moves the arm after the hold"
        assert controller.status().reason == "enough"


@pytest.mark.parametrize("how", ["line", "thread"])
def test_a_stop_outruns_a_target_that_waits(line: RemoteRobot, servo: ServoThread, how: str) -> None:
    for seq in range(1, 21):  # until the machine leaves it the time
        waits = target(seq, early=0.019)
        line.send(waits)
        line.request(Hold(reason="STOP", latch=True)) if how == "line" else servo.stop("STOP")
        stopped = time.monotonic()
        (ack,) = acknowledged(line, 1)
        wait_for(servo, lambda s: s.mode is RobotMode.LATCHED)
        if stopped < waits.due:
            assert "latched" in ack.refused
            return
        line.request(Resume())
    pytest.fail("a STOP never took less than 19 ms")
