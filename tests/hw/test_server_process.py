"""The hw server as a process: what it survives, what it says, and that it leaves nothing behind."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
import zmq

from far_app.endpoints import Endpoints
from far_app.errors import RobotError
from far_app.link import RemoteRobot
from far_app.protocols import Resume
from far_app.telemetry import GeometryRequest, SceneGeometry, StopAck, StopRequest, View
from far_app.types import Observation, RobotMode
from far_app.wire import pack, unpack
from tests.hw.conftest import RIG, TASK, HwProcess, RemoteBench

CLIENT = """
    import os, subprocess, sys, time
    import numpy as np
    from pathlib import Path
    from far_app.endpoints import Endpoints
    from far_app.link import RemoteRobot
    from far_app.motion import ActionScale, TargetIntegrator
    folder = sys.argv[1]
    server = subprocess.Popen([sys.executable, "-m", "hw.server", "--folder", folder, "--parent", str(os.getpid())],
                              stdout=subprocess.PIPE, text=True)
    server.stdout.readline()
    robot = RemoteRobot(Endpoints.in_folder(Path(folder)))
    print(server.pid, flush=True)
    integrator = TargetIntegrator(ActionScale(), robot.observe().eef)
    tick = 0
    while True:
        observation = robot.observe()
        for ack in observation.acks:
            integrator.executed(ack)
        action = np.array([0.0, 0.8 * np.sin(tick / 10), 0, 0, 0, 0, -1.0])
        robot.send(integrator.target(action, observation.eef, time.monotonic()))
        time.sleep(1 / 30)
        tick += 1
"""


class Onlooker:
    """Hears the server's observations without being its app."""

    def __init__(self, endpoint: str) -> None:
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.socket = self.context.socket(zmq.SUB)
        self.socket.subscribe(b"")
        self.socket.connect(endpoint)

    def until(self, what: Callable[[Observation], bool], limit: float = 10.0) -> Observation:
        deadline = time.monotonic() + limit
        while time.monotonic() < deadline:
            if self.socket.poll(200):
                observation = unpack(self.socket.recv())
                if what(observation):
                    return observation
        raise AssertionError("it never came to that")

    def close(self) -> None:
        self.context.destroy(linger=0)


class MovingArm:
    """An app in its own process, moving the arm of a server that it started; and an onlooker."""

    def __init__(self) -> None:
        self.folder = tempfile.mkdtemp(prefix="far-hw-")
        self.endpoints = Endpoints.in_folder(Path(self.folder))
        self.app = subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(CLIENT), self.folder], stdout=subprocess.PIPE, text=True
        )
        assert self.app.stdout is not None
        self.server = psutil.Process(int(self.app.stdout.readline()))
        self.onlooker = Onlooker(self.endpoints.observations)
        self.onlooker.until(lambda o: o.status.mode is RobotMode.TRACKING)

    def close(self) -> None:
        self.onlooker.close()
        for process in (self.app, self.server):
            with contextlib.suppress(psutil.NoSuchProcess, ProcessLookupError):
                process.kill()
        self.app.wait()


@pytest.fixture
def moving() -> Iterator[MovingArm]:
    arm = MovingArm()
    yield arm
    arm.close()


def press_stop(endpoints: Endpoints) -> tuple[StopAck, float]:
    """As the page does; the answer and the monotonic time of the press."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    socket = context.socket(zmq.REQ)
    socket.connect(endpoints.stop)
    pressed = time.monotonic()
    socket.send(pack(StopRequest(source="test", stamp=pressed)))
    assert socket.poll(5000), "no answer to STOP"
    answer = unpack(socket.recv())
    context.destroy(linger=0)
    assert isinstance(answer, StopAck)
    return answer, pressed


@pytest.mark.slow
def test_a_killed_app_leaves_the_arm_held_and_no_server(moving: MovingArm) -> None:
    moving.app.kill()
    held = moving.onlooker.until(lambda o: o.status.mode is RobotMode.HOLD)
    assert held.status.holds >= 1 or "the app is gone" in held.status.reason
    _, alive = psutil.wait_procs([moving.server], timeout=8)
    assert not alive, "the server outlived its app"


@pytest.mark.slow
def test_stop_latches_while_the_app_is_frozen(moving: MovingArm, record_property: Callable[..., None]) -> None:
    os.kill(moving.app.pid, signal.SIGSTOP)
    answer, pressed = press_stop(moving.endpoints)
    record_property("stop_to_latch_ms", 1e3 * (answer.latched - pressed))
    print(f"STOP to latch: {1e3 * (answer.latched - pressed):.2f} ms")
    assert answer.latched - pressed < 1.0
    latched = moving.onlooker.until(lambda o: o.status.mode is RobotMode.LATCHED)
    assert latched.status.reason == "STOP"
    os.kill(moving.app.pid, signal.SIGCONT)
    time.sleep(0.3)
    after = moving.onlooker.until(lambda o: o.stamp > latched.stamp + 0.2)
    assert after.status.mode is RobotMode.LATCHED, "targets do not undo a STOP"


@pytest.mark.slow
def test_a_killed_server_is_an_error_within_about_a_second() -> None:
    server = HwProcess()
    robot = RemoteRobot(server.endpoints)
    server.process.kill()
    server.process.wait()
    died = time.monotonic()
    with pytest.raises(RobotError, match="no observation from the hw server"):
        while time.monotonic() < died + 5:
            robot.observe()
            time.sleep(0.02)
    assert time.monotonic() - died < 3
    with pytest.raises(RobotError, match="did not answer Resume within 1 s"):
        robot.request(Resume())
    robot.close()
    server.close()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_told_server_ends_cleanly(number: signal.Signals) -> None:
    server = HwProcess()
    assert server.handshake["ready"]
    server.process.send_signal(number)
    assert server.process.wait(timeout=8) == 0


def test_the_page_gets_pictures_and_geometry(remote: RemoteBench) -> None:
    endpoints = remote.robot.endpoints
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    view_socket, geometry_socket = context.socket(zmq.SUB), context.socket(zmq.REQ)
    view_socket.subscribe(b"")
    view_socket.connect(endpoints.view)
    geometry_socket.connect(endpoints.geometry)
    geometry_socket.send(pack(GeometryRequest()))
    assert geometry_socket.poll(5000)
    geometry = unpack(geometry_socket.recv())
    assert isinstance(geometry, SceneGeometry)
    assert len(geometry.meshes) > 10
    assert view_socket.poll(10_000), "no view for a page that subscribed"
    view = unpack(view_socket.recv())
    assert isinstance(view, View)
    assert set(view.jpegs) == set(TASK.cameras)
    assert all(jpeg[:2] == b"\xff\xd8" for jpeg in view.jpegs.values())
    assert view.body_poses.shape == (len(geometry.body_names), 7)
    context.destroy(linger=0)


def test_junk_on_its_sockets_does_not_disturb_it(remote: RemoteBench) -> None:
    endpoints = remote.robot.endpoints
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    commands, geometry = context.socket(zmq.DEALER), context.socket(zmq.REQ)
    commands.connect(endpoints.commands)
    geometry.connect(endpoints.geometry)
    commands.send(b"junk")
    commands.send_multipart([b"1", b"junk"])
    commands.send_multipart([b"1", b"2", b"3", b"4"])
    commands.send(pack(StopRequest(source="wrong door", stamp=0.0)))
    geometry.send(b"junk")
    assert commands.poll(2000)
    number, raw = commands.recv_multipart()
    assert number == b"1"
    assert "refused" in unpack(raw).error
    assert geometry.poll(2000)
    context.destroy(linger=0)
    remote.start(seed=1)
    assert remote.drive(np.array((0.5, 0, 0, 0, 0, 0, -1.0)), 5)[-1].status.mode is RobotMode.TRACKING


@pytest.mark.parametrize(
    ("arguments", "kind", "words"),
    [
        (("--task", "juggle"), "ConfigError", "unknown task 'juggle'"),
        (("--rig", "nowhere"), "ConfigError", "known rigs"),
    ],
)
def test_a_wrong_setting_is_one_clear_line(arguments: tuple[str, ...], kind: str, words: str) -> None:
    server = HwProcess(*arguments)
    assert server.handshake["kind"] == kind
    assert words in server.handshake["error"]
    assert server.process.wait(timeout=10) == 2


@pytest.mark.slow
def test_no_graphics_is_one_clear_line() -> None:
    server = HwProcess(environment={"__EGL_VENDOR_LIBRARY_DIRS": "/nonexistent", "MUJOCO_GL": "egl"})
    assert server.handshake.get("kind") == "GraphicsError", server.handshake
    assert server.process.wait(timeout=10) == 2


def test_a_folder_too_deep_for_sockets_is_named() -> None:
    assert RIG.name == "twin"
    folder = "/tmp/" + "x" * 120
    run = subprocess.run(
        [sys.executable, "-m", "hw.server", "--folder", folder], capture_output=True, text=True, timeout=60, check=False
    )
    assert run.returncode == 2
    assert "choose a shorter folder" in run.stdout
