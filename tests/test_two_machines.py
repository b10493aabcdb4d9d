"""Robot PC and GPU PC: clocks that differ by hours, keys, and nothing served to strangers."""

from __future__ import annotations

import contextlib
import dataclasses
import getpass
import json
import math
import os
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq

from far_app.bench.machines import AHEAD, FAR, MOVED_CLOCK
from far_app.cli import main
from far_app.cli.agreement import agreed
from far_app.cli.options import RunOptions
from far_app.endpoints import HARDWARE, Call, Endpoints
from far_app.errors import ArmTaken, ConfigError, RobotError
from far_app.keys import client_keys, make_keys, server_keys
from far_app.link import RemoteRobot
from far_app.motion import TargetIntegrator
from far_app.protocols import Heartbeat, Hold, Home
from far_app.station import DRIFT, ClockAnswer, RobotClock, Station, StationQuery, asking, shifted, station_at
from far_app.telemetry import StopRequest
from far_app.types import Ack, Observation, RobotMode, RobotStatus, Target
from far_app.wire import pack, unpack
from hw.fake_xarm.control import FakeXArm
from hw.rig import load_rig
from hw.server import _for_a_person
from tests.hw.conftest import FAKE_PORT, loopback
from tests.recording.values import pose
from tests.test_real_arm import STEP, Run, stop_while_the_app_is_frozen

PORT = 20_000 + os.getpid() % 20_000


# ── clocks ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def exchange(clock: RobotClock, at: float, ahead: float, there: float = 0.001, back: float = 0.001) -> None:
    """One exchange of a clock that is `ahead`, with the two ways' seconds."""
    received = at + there + ahead
    clock.exchanged(ClockAnswer(sent=at, received=received, answered=received + 0.002), at + there + 0.002 + back)


def test_an_even_link_gives_the_offset_exactly_whatever_its_delay():
    clock = RobotClock()
    exchange(clock, 5.0, 36_000.0, 0.02, 0.02)
    assert clock.offset == pytest.approx(36_000.0, abs=1e-9)
    assert clock.round_trip == pytest.approx(0.04, abs=1e-9)


@pytest.mark.parametrize(("there", "back"), [(0.0, 0.04), (0.04, 0.0), (0.03, 0.01)])
def test_the_offset_is_never_further_off_than_its_bound(there: float, back: float):
    clock, now = RobotClock(), time.monotonic()
    exchange(clock, now - there - back - 0.002, -7_200.0, there, back)
    assert abs(clock.offset + 7_200.0) <= clock.bound() + 1e-6


def test_the_exchange_with_the_shortest_way_is_believed_until_drift_outweighs_it():
    clock = RobotClock()
    exchange(clock, 0.0, 10.0, 0.001, 0.001)
    exchange(clock, 1.0, 10.0, 0.030, 0.001)
    assert clock.offset == pytest.approx(10.0, abs=1e-9), "the second is 14.5 ms off"
    later = 2.0 + 0.010 / DRIFT
    exchange(clock, later, 10.0 + 0.01, 0.004, 0.004)
    assert clock.offset == pytest.approx(10.01, abs=1e-9), "the first could be further off by now"


def test_every_time_that_crosses_is_translated_and_nothing_else_is():
    ack = Ack(seq=1, accepted=1.0, due=2.0, pose=pose(0), gripper=0.0)
    messages: list[Any] = [
        ack, Target(seq=1, pose=pose(0), gripper=0.5, created=1.0, expires=2.0, due=3.0),
        Call(request=Heartbeat(), expires=3.0),
        Observation(
            seq=1, stamp=4.0, eef=pose(0), gripper=0.0, joints=np.zeros(7), acks=(ack,),
            status=RobotStatus(mode=RobotMode.HOLD, homing_progress=0.5),
        ),
    ]  # fmt: skip
    times = {"accepted", "due", "created", "expires", "stamp"}
    for message in messages:
        moved = shifted(message, 100.0)
        for field in dataclasses.fields(message):
            before, after = getattr(message, field.name), getattr(moved, field.name)
            if field.name in times:
                assert after == before + 100.0
            elif field.name == "acks":
                assert after == (shifted(ack, 100.0),)
            else:
                assert after is before
    with pytest.raises(TypeError, match="has no place"):
        shifted(Home(), 1.0)


# ── keys ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_keys_are_their_owners_alone_and_never_overwritten_unasked(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = tmp_path / "keys"
    assert main(["keys", "--out", str(folder)]) == 0
    assert sorted(p.name for p in folder.iterdir()) == [
        "client.key", "client.key_secret", "server.key", "server.key_secret"
    ]  # fmt: skip
    assert {stat.S_IMODE(p.stat().st_mode) for p in folder.iterdir()} == {0o600}
    before = server_keys(folder)
    assert main(["keys", "--out", str(folder)]) == 2
    assert "would be lost" in capsys.readouterr().err
    assert server_keys(folder) == before
    assert main(["keys", "--out", str(folder), "--overwrite"]) == 0
    assert server_keys(folder) != before
    assert client_keys(folder).server == server_keys(folder).public


def test_a_secret_that_others_can_read_or_that_is_missing_is_refused(tmp_path: Path):
    make_keys(tmp_path)
    (tmp_path / "server.key_secret").chmod(0o640)
    with pytest.raises(ConfigError, match=r"mode 640, at most 600.*chmod 600"):
        server_keys(tmp_path)
    (tmp_path / "client.key_secret").unlink()
    with pytest.raises(ConfigError, match="far keys --out"):
        client_keys(tmp_path)
    (tmp_path / "server.key_secret").chmod(0o600)
    (tmp_path / "client.key").unlink()
    with pytest.raises(ConfigError, match="nobody could connect"):
        server_keys(tmp_path)


@pytest.mark.parametrize("address", ["tcp://0.0.0.0:5600", "tcp://192.168.1.9:5600", "tcp://robot-pc:5600"])
def test_without_keys_any_address_but_loopback_is_refused_on_both_sides(
    address: str, capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(ConfigError, match="far keys --out"):
        Endpoints.at(address, None)
    for command in (["hw-server", "--bind", address], ["run", "--headless", "--policy", "test:still", "--hw", address]):
        assert main(command) == 2
        assert "without keys anybody there could move the arm" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("bound", "said"), [("tcp://0.0.0.0:5600", "tcp://THIS-MACHINE:5600"), ("tcp://10.0.0.9:1", "tcp://10.0.0.9:1")]
)
def test_a_server_that_is_ready_says_what_to_type_on_the_other_machine(bound: str, said: str):
    assert f"far run --hw {said} …" in _for_a_person({"ready": True}, bound)


@pytest.mark.parametrize("address", ["192.168.1.9:5600", "tcp://127.0.0.1", "tcp://:5600", "ipc://x", "tcp://[::1]:56"])
def test_an_address_that_is_none_is_refused(address: str):
    with pytest.raises(ConfigError, match="is not tcp://HOST:PORT"):
        Endpoints.at(address, None)


def test_the_rig_here_must_be_the_rig_there():
    rig = load_rig("xarm7")
    its = dataclasses.asdict(rig)
    its["xarm"]["address"] = "192.168.1.55"
    assert agreed(rig, "lift", Station(rig=its, task="lift")).xarm.address == "192.168.1.55"
    its["safety"]["speed"] = 0.05
    with pytest.raises(ConfigError, match=r"safety.speed is .* here and 0.05 there"):
        agreed(rig, "lift", Station(rig=its, task="lift"))
    with pytest.raises(ConfigError, match="--task square here"):
        agreed(rig, "lift", Station(rig=its, task="square"))


def test_a_real_arm_that_another_machine_drives_is_not_run_headless():
    rig = load_rig("xarm7")
    with pytest.raises(ConfigError, match="needs somebody who watches its page"):
        RunOptions(robot="xarm", headless=True).refuse_unwatched(rig)


# ── the hw server on another machine's clock ────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    make_keys(folder)
    return folder


@pytest.fixture(scope="module")
def controller() -> Iterator[FakeXArm]:
    fake = FakeXArm.start(loopback(), FAKE_PORT)
    yield fake
    fake.close()


@pytest.fixture(scope="module")
def address(keys: Path, controller: FakeXArm) -> Iterator[str]:
    """`far hw-server` with its clock ten hours ahead."""
    fake = controller
    address = f"tcp://127.0.0.1:{PORT}"
    words = ["hw-server", "--bind", address, "--keys", str(keys), "--robot", "xarm", "--host"]
    server = subprocess.Popen(
        [sys.executable, "-c", MOVED_CLOCK, *words, f"{fake.address}:{FAKE_PORT}"], stdout=subprocess.PIPE, text=True
    )
    assert server.stdout is not None
    assert f"far run --hw {address}" in server.stdout.readline()
    yield address
    server.terminate()
    assert server.wait(10) == 0


@pytest.fixture
def endpoints(address: str, keys: Path) -> Endpoints:
    return Endpoints.at(address, client_keys(keys))


def test_targets_ages_and_acknowledgments_are_right_between_clocks_ten_hours_apart(endpoints: Endpoints):
    robot = RemoteRobot(endpoints, connect_timeout=10.0)
    try:
        assert robot.clock.offset == pytest.approx(AHEAD, abs=0.02)
        assert abs(robot.clock.offset - AHEAD) < robot.clock.bound() + 1e-3
        integrator = TargetIntegrator(load_rig("xarm7").scale, robot.observe().eef)
        acks: list[Ack] = []
        dues: dict[int, float] = {}
        for _ in range(30):
            observation = robot.observe()
            acks += observation.acks
            assert -0.01 < time.monotonic() - observation.stamp < 0.25
            due = time.monotonic()
            target = integrator.target(np.array([0.1, 0, 0, 0, 0, 0, -1.0]), observation.eef, due)
            dues[target.seq] = due
            robot.send(target)
            time.sleep(1 / 30)
        assert len(acks) > 20 and not [a.refused for a in acks if a.refused]
        for ack in acks:
            assert ack.due == pytest.approx(dues[ack.seq], abs=1e-3)
            assert -0.01 < ack.accepted - ack.due < 0.1
        expired = dataclasses.replace(
            integrator.target(np.zeros(7), robot.observe().eef, time.monotonic()), expires=time.monotonic() - 0.01
        )
        robot.send(expired)
        time.sleep(0.3)
        refused = [a.refused for a in robot.observe().acks if a.seq == expired.seq]
        assert refused and "expired" in refused[0], refused
        assert robot.observe().status.mode is RobotMode.HOLD, "the watchdog"
    finally:
        robot.close()


@pytest.mark.parametrize("request_", [Home(), Hold(reason="test")], ids=["home", "hold"])
def test_a_request_that_lay_in_a_cut_cable_does_not_act_but_a_hold_does(endpoints: Endpoints, request_: Home | Hold):
    with zmq.Context() as context:
        endpoints.secure(context)
        socket = context.socket(zmq.DEALER)
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(endpoints.commands)
        socket.send_multipart([b"1", pack(Call(request=request_, expires=time.monotonic() + AHEAD - 5.0))])
        assert socket.poll(5000)
        reply = unpack(socket.recv_multipart()[1])
        assert reply.status.mode is RobotMode.HOLD
        assert ("gave it up" in reply.error) is isinstance(request_, Home)
        socket.close()


def test_one_app_leads_an_arm_and_a_second_is_told_who_does(endpoints: Endpoints):
    me = f"{getpass.getuser()}@.*, process {os.getpid()};"
    first = RemoteRobot(endpoints, connect_timeout=10.0)
    with pytest.raises(ArmTaken, match=me):
        RemoteRobot(endpoints, connect_timeout=10.0)
    with pytest.raises(ArmTaken, match=me):
        agreed(load_rig("xarm7"), "lift", station_at(endpoints))
    with zmq.Context() as context:
        endpoints.secure(context)
        socket = context.socket(zmq.DEALER)
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(endpoints.commands)
        for number, request in enumerate((Home(), Hold(reason="anybody may"))):
            call = Call(request=request, expires=time.monotonic() + AHEAD + 5.0)
            socket.send_multipart([str(number).encode(), pack(call)])
            assert socket.poll(5000)
            reply = unpack(socket.recv_multipart()[1])
            assert ("led by" in reply.error) is isinstance(request, Home)
        socket.close()
    first.request(Home())
    first.close()
    second = RemoteRobot(endpoints, connect_timeout=10.0)
    second.request(Hold(reason="it leads now"))
    second.close()


def test_a_station_says_what_it_drives(endpoints: Endpoints):
    station = station_at(endpoints)
    assert station.task == "lift" and station.rig["robot"] == "xarm"


@pytest.mark.parametrize("stranger", ["no keys", "keys of its own", "the right server, a key of its own"])
def test_strangers_are_served_nothing_on_any_socket(endpoints: Endpoints, tmp_path: Path, keys: Path, stranger: str):
    make_keys(tmp_path)
    if stranger == "no keys":
        theirs = dataclasses.replace(endpoints, keys=None)
    else:
        if stranger.startswith("the right server"):
            (tmp_path / "server.key").write_text((keys / "server.key").read_text())
        theirs = dataclasses.replace(endpoints, keys=client_keys(tmp_path))
    context = zmq.Context()
    theirs.secure(context)
    kinds = dict.fromkeys(HARDWARE, zmq.REQ) | {"observations": zmq.SUB, "view": zmq.SUB, "commands": zmq.DEALER}
    sockets = {}
    for name, kind in kinds.items():
        sockets[name] = socket = context.socket(kind)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.SNDTIMEO, 1000)  # once a handshake is refused there is nobody to send to
        if kind == zmq.SUB:
            socket.subscribe(b"")
        socket.connect(getattr(theirs, name))
        with contextlib.suppress(zmq.Again):
            if name == "commands":
                call = Call(request=Hold(reason="a stranger", latch=True), expires=math.inf)
                socket.send_multipart([b"1", pack(call)])
            elif kind == zmq.REQ:
                question = StopRequest(source="a stranger", stamp=0.0) if name == "stop" else StationQuery()
                socket.send(pack(question))
    time.sleep(1.0)
    assert [name for name, socket in sockets.items() if socket.poll(0)] == []
    context.destroy(linger=0)
    robot = RemoteRobot(endpoints, connect_timeout=10.0)
    assert robot.observe().status.mode is RobotMode.HOLD, "no stranger stopped it either"
    robot.close()


def test_what_was_wrong_is_said(endpoints: Endpoints, tmp_path: Path):
    make_keys(tmp_path)
    with pytest.raises(RobotError, match="knows other keys"):
        station_at(dataclasses.replace(endpoints, keys=client_keys(tmp_path)), patience=1.5)
    with pytest.raises(RobotError, match="asks for keys"):
        station_at(dataclasses.replace(endpoints, keys=None), patience=1.5)
    with pytest.raises(RobotError, match="nobody listens"):
        station_at(Endpoints.at("tcp://127.0.0.1:9", None), patience=0.6)


def test_a_socket_to_ask_may_give_up_and_ask_again(endpoints: Endpoints):
    with zmq.Context() as context:
        endpoints.secure(context)
        socket = asking(context, endpoints.station)
        socket.send(pack(StationQuery()))
        socket.send(pack(StationQuery()))
        assert socket.poll(3000)
        assert isinstance(unpack(socket.recv()), Station)
        socket.close()


@pytest.mark.slow
def test_stop_from_the_page_reaches_the_other_machine_while_the_app_is_frozen(
    controller: FakeXArm, address: str, keys: Path, tmp_path: Path
):
    run = Run(controller, tmp_path, "--full-speed", server=("--hw", address, "--keys", str(keys)))
    stop_while_the_app_is_frozen(run, controller)


@pytest.mark.slow
def test_a_slow_and_stalling_cable_means_holds_and_never_a_jump(tmp_path: Path):
    done = subprocess.run(
        [sys.executable, "-c", FAR, "bench", "link", "--json", str(tmp_path / "link.json"), "--seconds", "6", "--cuts",
         "1", "--stops", "2"], check=False, capture_output=True, text=True, timeout=200,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "link.json").read_text())
    assert found["stalls"]["stalls"] <= found["stalls"]["holds"] + 1 and found["stalls"]["holds"] > 0
    (pulled,) = found["cuts"]
    assert pulled["noticed"] and pulled["moved_before_resume_mm"] < 0.1 and pulled["first_target_after_mm"] < 0.5
    assert pulled["hold_ms"] < 400.0
    assert max(found[phase]["largest_step_mm"] for phase in ("steady", "stalls")) < STEP
    assert pulled["largest_step_mm"] < STEP and found["stalls"]["outside_box"] == 0
    assert found["stop"]["frames"] == 2
    assert abs(found["clock"]["error_ms"]) <= found["clock"]["bound_ms"]
