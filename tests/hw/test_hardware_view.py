"""Cameras of a rig's own behind the server's threads: what the app is shown, and what a lost camera does to the arm."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import zmq

from far_app.endpoints import Endpoints
from far_app.link import RemoteRobot
from far_app.protocols import Resume
from far_app.types import RobotMode
from hw.camera_config import CameraConfig, with_views
from hw.camera_thread import CameraThread, Pictures
from hw.hardware_view import HardwareView
from hw.rig import RIGS
from hw.servo_thread import ServoThread
from hw.synthetic_camera import SyntheticCapture, number_in
from tests.hw.conftest import HwProcess
from tests.hw.test_threads import RIG, TASK, BlindView, plant, servo, wait_for  # noqa: F401 (fixtures)

CONFIG = CameraConfig(device="synthetic", width=512, height=144, eye="left", rate=60.0, lost_after=0.4)
CAMERAS = {"front": CONFIG, "wrist": replace(CONFIG, width=144, eye="")}


@dataclass
class Bench:
    captures: dict[str, SyntheticCapture] = field(default_factory=dict)
    pictures: list[Pictures] = field(default_factory=list)


@pytest.fixture
def bench(servo: ServoThread) -> Iterator[Bench]:  # noqa: F811
    """A camera thread over two synthetic cameras."""
    bench = Bench()
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()

    def capture(name: str, config: CameraConfig) -> SyntheticCapture:
        return bench.captures.setdefault(name, SyntheticCapture(config))

    def lost(reason: str) -> None:
        with servo.locked() as controller:
            controller.fail(reason)

    cameras = CameraThread(
        lambda: HardwareView(BlindView(good=0), CAMERAS, capture), RIG, with_views(TASK, CAMERAS), servo, context,
        Endpoints.in_folder(Path(tempfile.mkdtemp(prefix="far-hw-"))).view, bench.pictures.append, lost,
    )  # fmt: skip
    cameras.start()
    yield bench
    cameras.close()
    context.destroy(linger=0)


def test_the_newest_frame_is_sampled_at_the_policys_rate_with_its_own_timestamp(bench: Bench) -> None:
    time.sleep(1.5)
    pictures = bench.pictures[5:]
    assert len(pictures) > 25
    stamps = np.array([p.stamp for p in pictures])
    assert (np.diff(stamps) > 0).mean() > 0.95, "hardly a picture twice"
    numbers = [number_in(p.images["front"]) for p in pictures]
    assert np.median(np.diff(numbers)) == 2, "every second frame of 60"
    assert all(set(p.images) == {"front", "wrist"} and p.images["wrist"].shape == (84, 84, 3) for p in pictures)


def test_a_stamp_is_the_oldest_cameras(bench: Bench) -> None:
    bench.captures["wrist"].delay = 0.1
    time.sleep(0.6)
    assert time.monotonic() - bench.pictures[-1].stamp > 0.08


def test_a_lost_camera_latches_the_arm_and_when_it_is_back_the_operator_resumes(
    bench: Bench, servo: ServoThread  # noqa: F811
) -> None:  # fmt: skip
    time.sleep(0.2)
    bench.captures["wrist"].unplugged = True
    status = wait_for(servo, lambda s: s.fault)
    assert status.mode is RobotMode.LATCHED and "camera wrist is lost" in status.reason
    with servo.locked() as controller:
        controller.request(Resume(), time.monotonic())
    wait_for(servo, lambda s: s.fault)  # resumed too early: told again

    bench.captures["wrist"].unplugged = False
    deadline = time.monotonic() + 5
    while time.monotonic() - bench.pictures[-1].stamp > 0.1:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    with servo.locked() as controller:
        controller.request(Resume(), time.monotonic())
    time.sleep(1.3)
    with servo.locked() as controller:
        assert not controller.status().fault, "works on"


@pytest.mark.slow
def test_a_whole_server_with_cameras_of_its_own(tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(
        (RIGS / "twin.toml").read_text()
        + '\n[camera.front]\ndevice = "synthetic"\nwidth = 1344\nheight = 376\neye = "left"\n'
    )
    server = HwProcess("--rig", str(rig))
    assert server.handshake.get("ready") and server.handshake["cameras"] == ["front"], server.handshake
    robot = RemoteRobot(server.endpoints)
    first = robot.observe()
    time.sleep(1.0)
    last = robot.observe()
    assert last.images["front"].shape == (84, 84, 3)
    assert 30 <= number_in(last.images["front"]) - number_in(first.images["front"]) <= 90
    assert time.monotonic() - last.stamp < 0.2
    robot.close()
    assert server.close() == 0


@pytest.mark.slow
def test_a_camera_that_is_not_there_ends_the_servers_start_in_one_line(tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text((RIGS / "twin.toml").read_text() + '\n[camera.front]\ndevice = "/dev/video-none"\n')
    server = HwProcess("--rig", str(rig))
    assert "camera front: /dev/video-none cannot be opened" in str(server.handshake["error"])
    assert server.process.wait(10) == 2
