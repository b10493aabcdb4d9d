"""One robot three times, for the contract tests: the twin in lockstep in this process, the twin behind sockets in its
own, and a real arm's driver there against the fake controller."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from far_app.endpoints import Endpoints
from far_app.link import RemoteRobot
from far_app.motion import TargetIntegrator
from far_app.protocols import Heartbeat, Home, Reset, Resume, Robot
from far_app.tasks import task
from far_app.types import Ack, Observation, RobotMode, Target
from hw.fake_xarm.control import FakeXArm
from hw.lockstep import LockstepRobot
from hw.rig import RIGS, load_rig
from hw.twin import TwinPlant
from hw.twin_view import TwinView
from hw.xarm7.settings import FAKE_PORT

RIG, TASK = load_rig("twin"), task("lift")
XARM = load_rig("xarm7")
XARM = replace(XARM, home=replace(XARM.home, speed=0.25, rotation_speed=1.2))
"""The shipped rig, in a hurry to get home."""
_addresses = itertools.count(1)


def loopback() -> str:
    """A loopback address of this process's own: the fake controller's report ports are fixed."""
    return f"127.{20 + os.getpid() // 250 % 200}.{1 + os.getpid() % 250}.{next(_addresses)}"


class Bench:
    """A robot and the passing of policy ticks, on its own clock."""

    rig = RIG
    cameras = TASK.cameras

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.acks: list[Ack] = []
        """Every acknowledgment observed so far."""
        self.sent: list[int] = []

    def now(self) -> float:
        raise NotImplementedError

    def tick(self) -> float:
        """Let one policy tick pass; returns the time."""
        raise NotImplementedError

    def observe(self) -> Observation:
        """After a tick."""
        observation = self.robot.observe()
        self.acks.extend(observation.acks)
        return observation

    def ack(self, seq: int) -> Ack:
        """The acknowledgment of one target, waited for where the machine is busy."""
        for _ in range(30):
            found = [ack for ack in self.acks if ack.seq == seq]
            if found:
                return found[0]
            self.tick()
            self.observe()
        raise AssertionError(f"target {seq} was never acknowledged")

    def until(self, what: Callable[[Observation], bool]) -> Observation:
        """Ticks until an observation shows it."""
        for _ in range(60):
            self.tick()
            observation = self.observe()
            if what(observation):
                return observation
        raise AssertionError(f"it never came to that: {observation.status}")

    def start(self, seed: int) -> Observation:
        """A fresh scene, whatever a test before left behind."""
        self.robot.request(Resume())
        self.robot.request(Reset(seed=seed))
        before = self.robot.observe().seq
        for _ in range(4):
            self.tick()
        observation = self.until(lambda o: o.seq > before + 2)
        self.acks.clear()
        self.sent.clear()
        return observation

    def drive(self, action: np.ndarray, ticks: int) -> list[Observation]:
        """The same action for a while, as a policy would; the observation after each tick."""
        integrator = TargetIntegrator(self.rig.scale, self.observe().eef)
        observations = []
        for _ in range(ticks):
            observation = self.robot.observe()
            self.send(integrator.target(action, observation.eef, self.now()))
            self.tick()
            observations.append(self.observe())
            for ack in observations[-1].acks:
                integrator.executed(ack)
        return observations

    def send(self, target: Target) -> None:
        self.sent.append(target.seq)
        self.robot.send(target)

    def go_home(self, limit: int = 300) -> Observation:
        self.robot.request(Home())
        for _ in range(limit):
            self.tick()
            self.robot.request(Heartbeat())
            observation = self.observe()
            if observation.status.at_home or observation.status.mode is RobotMode.LATCHED:
                return observation
        raise AssertionError(f"not home after {limit} ticks: {observation.status}")


class LockstepBench(Bench):
    robot: LockstepRobot

    def now(self) -> float:
        return self.robot.now

    def tick(self) -> float:
        return self.robot.advance()


class RemoteBench(Bench):
    robot: RemoteRobot

    def now(self) -> float:
        return time.monotonic()

    def tick(self) -> float:
        time.sleep(1 / TASK.rate)
        return time.monotonic()


class XArmBench(RemoteBench):
    """The driver on the fake controller: no scene to reset, so a start is a way home."""

    rig, cameras = XARM, ()

    def __init__(self, robot: RemoteRobot, fake: FakeXArm, server: HwProcess) -> None:
        super().__init__(robot)
        self.fake, self.server = fake, server

    def start(self, seed: int) -> Observation:
        self.robot.request(Resume())
        self.robot.request(Reset(seed=seed))
        observation = self.go_home()
        assert observation.status.at_home, observation.status
        for _ in range(3):
            self.tick()
        self.observe()
        self.acks.clear()
        self.sent.clear()
        self.fake.received()
        return observation


class HwProcess:
    """A real hw server in its own process."""

    def __init__(self, *arguments: str, environment: dict[str, str] | None = None) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="far-hw-"))
        self.endpoints = Endpoints.in_folder(self.folder)
        command = [sys.executable, "-m", "hw.server", "--folder", str(self.folder), "--parent", str(os.getpid())]
        self.process = subprocess.Popen(
            [*command, *arguments], stdout=subprocess.PIPE, text=True, env=os.environ | (environment or {})
        )
        assert self.process.stdout is not None
        self.handshake = json.loads(self.process.stdout.readline())

    def close(self) -> int:
        self.process.terminate()
        code = self.process.wait(timeout=10)
        shutil.rmtree(self.folder, ignore_errors=True)
        return code


@pytest.fixture(scope="session")
def plant() -> TwinPlant:
    return TwinPlant(RIG, TASK)


@pytest.fixture(scope="session")
def lockstep(plant: TwinPlant) -> Iterator[LockstepBench]:
    view = TwinView(plant.model_xml(), plant.base_pose(), plant.cameras())
    yield LockstepBench(LockstepRobot(plant, view, RIG, TASK))
    view.close()


@pytest.fixture(scope="module")
def remote() -> Iterator[RemoteBench]:
    server = HwProcess()
    assert server.handshake.get("ready"), server.handshake
    robot = RemoteRobot(server.endpoints)
    yield RemoteBench(robot)
    robot.close()
    assert server.close() == 0


@pytest.fixture(scope="module")
def fake() -> Iterator[FakeXArm]:
    fake = FakeXArm.start(loopback(), FAKE_PORT)
    yield fake
    fake.close()


@pytest.fixture(scope="module")
def xarm(fake: FakeXArm, tmp_path_factory: pytest.TempPathFactory) -> Iterator[XArmBench]:
    text = (RIGS / "xarm7.toml").read_text()
    hurried = tmp_path_factory.mktemp("rig") / "hurried.toml"
    hurried.write_text(text.replace("speed = 0.15\nrotation_speed = 0.8", "speed = 0.25\nrotation_speed = 1.2"))
    server = HwProcess("--rig", str(hurried), "--address", f"{fake.address}:{FAKE_PORT}")
    assert server.handshake.get("ready"), server.handshake
    robot = RemoteRobot(server.endpoints)
    yield XArmBench(robot, fake, server)
    robot.close()
    assert server.close() == 0


@pytest.fixture(params=["lockstep", "remote", "xarm"])
def bench(request: pytest.FixtureRequest) -> Bench:
    return request.getfixturevalue(request.param)


@pytest.fixture(params=["lockstep", "remote"])
def twin_bench(request: pytest.FixtureRequest) -> Bench:
    """What only a twin can promise: a scene that is put in place, and told of."""
    return request.getfixturevalue(request.param)
