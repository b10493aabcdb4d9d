"""A servo thread, the driver and the fake controller, in reach of one test."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from far_app.config import TaskConfig
from far_app.motion import TargetIntegrator
from far_app.protocols import Heartbeat, Hold, Home, Resume
from far_app.tasks import task
from far_app.types import RobotStatus
from hw.controller import ArmController
from hw.fake_xarm.control import FakeXArm
from hw.rig import RigConfig, at_address, load_rig
from hw.servo_thread import ServoThread
from hw.xarm7.plant import XArmPlant

TASK = task("lift")
FORWARD = np.array((1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0))
BACK = -FORWARD + np.array((0, 0, 0, 0, 0, 0, -2.0))
RESUMING = 15.0


def rig_at(fake: FakeXArm, port: int) -> RigConfig:
    """The shipped rig, in a hurry."""
    rig = at_address(load_rig("xarm7"), f"{fake.address}:{port}")
    return replace(rig, home=replace(rig.home, speed=0.25, rotation_speed=1.2, open_seconds=1.0))


class Cell:
    """Everything of the hw server but its sockets."""

    def __init__(self, fake: FakeXArm, rig: RigConfig, task: TaskConfig = TASK) -> None:
        self.fake, self.rig = fake, rig
        self.plant = XArmPlant(rig, task)
        self.servo = ServoThread(self.plant, ArmController(rig, task, 100, self.plant.measure()), task.rate)
        self.servo.start()

    @property
    def status(self) -> RobotStatus:
        with self.servo.locked() as controller:
            return controller.status()

    def until(self, what: Callable[[RobotStatus], bool], limit: float = 5.0) -> RobotStatus:
        """Waits for a status; heartbeats are not sent."""
        deadline = time.monotonic() + limit
        while time.monotonic() < deadline:
            status = self.status
            if what(status):
                return status
            time.sleep(0.005)
        raise AssertionError(f"it never came to that: {status}")

    def request(self, request: Home | Hold | Resume | Heartbeat) -> None:
        """Raises RobotError where it is refused."""
        with self.servo.locked() as controller:
            controller.request(request, time.monotonic())

    def go_home(self, limit: float = 10.0) -> None:
        self.request(Home())
        self.beat_until(lambda s: s.at_home, limit)

    def beat_until(self, what: Callable[[RobotStatus], bool], limit: float = 10.0) -> RobotStatus:
        """Lets homing go on until a status shows it."""
        deadline = time.monotonic() + limit
        while not what(status := self.status):
            assert time.monotonic() < deadline, f"it never came to that: {status}"
            self.request(Heartbeat())
            time.sleep(1 / TASK.rate)
        return status

    def drive(self, action: np.ndarray, ticks: int, until_held: bool = False) -> int:
        """The same action for a while, as a session would; returns how many targets were refused."""
        integrator, refused = TargetIntegrator(self.rig.scale, self.servo.newest.measured.eef), 0
        due = time.monotonic()
        for _ in range(ticks):
            target = integrator.target(action, self.servo.newest.measured.eef, time.monotonic())
            with self.servo.locked() as controller:
                controller.offer(target, time.monotonic())
                for ack in controller.take_acks():
                    integrator.executed(ack)
                    refused += bool(ack.refused)
            due += 1 / TASK.rate
            time.sleep(max(0.0, due - time.monotonic()))
            if until_held and refused:
                break
        return refused

    def resume(self) -> None:
        """Raises RobotError as the operator would read it."""
        self.servo.resume().result(timeout=RESUMING)

    def close(self) -> None:
        self.servo.close()
        self.plant.close()


def steps(targets: list[dict]) -> np.ndarray:
    """Millimetres between successive servo targets."""
    return np.linalg.norm(np.diff(np.array([t["pose"][:3] for t in targets]).reshape(-1, 3), axis=0), axis=1)
