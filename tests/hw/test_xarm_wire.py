"""What reaches a controller, seen where it arrives: the driver through the unmodified SDK on the fake controller."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from far_app.errors import ConfigError, RobotError
from far_app.protocols import Hold, Resume
from far_app.types import Pose, RobotMode
from hw.controller import ArmController
from hw.fake_xarm.control import FakeXArm
from hw.fake_xarm.protocol import Function
from hw.rig import at_address, load_rig
from hw.xarm7 import sdk
from hw.xarm7.plant import XArmPlant
from hw.xarm7.sdk import connect
from tests.hw.cell import BACK, FORWARD, TASK, Cell, rig_at, steps
from tests.hw.conftest import FAKE_PORT, XArmBench, loopback

pytestmark = pytest.mark.filterwarnings("ignore:The 'warn' method is deprecated")  # the SDK's
STEP = 2.5 + 1e-3
"""Millimetres a servo step may be, and the wire's rounding."""


@pytest.fixture
def cell(fake: FakeXArm) -> Iterator[Cell]:
    fake.received()
    cell = Cell(fake, rig_at(fake, FAKE_PORT))
    yield cell
    fake.faults(latency=0.0, jitter=0.0, stall=0.0, mute=False, reports_stalled=False)
    cell.close()


def test_the_sdk_leaves_the_timeout_of_the_whole_process_alone(fake: FakeXArm) -> None:
    """Its threads connect anew by themselves, so that undoing it after each connection would be too early."""
    for port in (FAKE_PORT, 1):
        connection = sdk.socket_port.SocketPort(fake.address, port, forbid_uds=True)
        assert socket.getdefaulttimeout() is None
        assert connection.connected == (port == FAKE_PORT)
        connection.close()


def test_the_start_sequence_ends_in_servo_mode_primed_with_the_present_pose(cell: Cell, fake: FakeXArm) -> None:
    received = fake.received()
    setup = [
        (r["function"], r["argument"]) for r in received
        if r["function"] in (Function.MOTION_EN, Function.SET_MODE, Function.SET_STATE)
    ]  # fmt: skip
    assert setup == [
        (Function.MOTION_EN, 1), (Function.SET_MODE, 0), (Function.SET_STATE, 0), (Function.SET_MODE, 1),
        (Function.SET_STATE, 0),
    ]  # fmt: skip
    after_mode = received[[r["function"] for r in received].index(Function.SET_MODE) :]
    primes = [r for r in after_mode if r["function"] == Function.MOVE_SERVO_CART_AA][:5]
    np.testing.assert_allclose([p["pose"][:3] for p in primes], [fake.state()["position"]] * 5, atol=0.01)
    functions = {r["function"] for r in received}
    assert Function.SET_COLLISION_SENSITIVITY not in functions
    assert Function.CLEAN_ERR not in functions
    assert socket.getdefaulttimeout() is None


def test_servo_steps_keep_the_rigs_limits_at_every_tick(
    cell: Cell, fake: FakeXArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    anew, start_anew = [], ArmController._start_anew

    def noted(controller: ArmController) -> None:
        anew.append(time.monotonic())
        start_anew(controller)

    monkeypatch.setattr(ArmController, "_start_anew", noted)
    cell.go_home()
    cell.drive(FORWARD, 15)
    cell.drive(BACK, 15)
    targets = fake.servo_targets()
    size = steps(targets)
    assert 2.0 < size.max() < STEP
    position, at = np.array([t["pose"][:3] for t in targets]) / 1e3, np.array([t["at"] for t in targets])
    change = np.linalg.norm(np.diff(position, n=2, axis=0), axis=1) / 0.01**2
    # where the machine paused, the arm came to rest at the last target, and its speed starts from zero
    rested = np.isin(np.arange(len(change)), np.searchsorted(at, anew) - 2)
    assert rested.mean() < 0.1
    assert change[~rested].max() < 1.05 * cell.rig.safety.acceleration, "m/s², at 100 Hz"
    quaternions = np.array([t["pose"][3:] for t in targets])
    turns = 2 * np.arccos(np.clip(np.abs((quaternions[1:] * quaternions[:-1]).sum(1)), -1, 1))
    assert turns.max() < cell.rig.xarm.servo_turn, "axis-angle wraps near gripper-down, the targets do not"


def test_the_drivers_last_line_holds_whatever_comes_from_above(fake: FakeXArm) -> None:
    plant = XArmPlant(rig_at(fake, FAKE_PORT), TASK)
    try:
        fake.received()
        here = plant.measure().eef
        plant.servo(Pose(position=here.position + 0.3, quaternion=np.array((0, 1.0, 0, 0))), -1.0)
        plant.servo(Pose(position=np.full(3, np.nan), quaternion=here.quaternion), -1.0)
        (leap,) = fake.servo_targets()
        assert np.linalg.norm(np.array(leap["pose"][:3]) - here.position * 1e3) < STEP
        assert "not a finite number" in plant.measure().error
    finally:
        plant.close()


def test_after_a_stall_nothing_is_caught_up_and_speed_starts_from_zero(cell: Cell, fake: FakeXArm) -> None:
    cell.go_home()
    fake.received()
    fake.faults(stall=0.19, stall_every=10.0, stall_in=0.4)
    cell.drive(FORWARD, 25)
    targets = fake.servo_targets()
    at = np.array([t["at"] for t in targets])
    size = steps(targets)
    gaps = np.diff(at)
    assert size.max() < STEP
    late = int(gaps.argmax())
    assert gaps[late] > 0.05, "the stall was there"
    window = at[late + 1] + 0.1
    assert (at[late + 1 :] < window).sum() < 14, "about ten in a tenth of a second, no burst"
    assert size[late + 1 : late + 3].min() < 1.0, "the arm came to rest at the last target: it starts anew"
    gained = 1e3 * cell.rig.safety.acceleration * 0.01**2
    assert np.diff(size[late + 1 :]).max() < 1.05 * gained, "millimetres a step may grow by"
    assert cell.status.mode is not RobotMode.LATCHED


@pytest.mark.parametrize("stuck", [False, True], ids=["idle", "servo call waits"])
def test_stop_is_on_the_wire_at_once_on_a_connection_of_its_own(cell: Cell, fake: FakeXArm, stuck: bool) -> None:
    if stuck:
        fake.faults(latency=0.09)
    cell.drive(FORWARD, 8)
    fake.received()
    asked = time.monotonic()
    cell.servo.stop("STOP")
    cell.until(lambda s: s.mode is RobotMode.LATCHED and s.reason == "STOP")
    time.sleep(0.3)
    received = fake.received()
    stops = [r for r in received if r["function"] == Function.SET_STATE and r["argument"] == 4]
    assert 0 < stops[0]["at"] - asked < 0.05, "5 ms is measured by the benchmark; here the machine may be busy"
    assert stops[0]["connection"] not in {r["connection"] for r in received if r["function"] == 93}
    assert cell.plant.links.stop.confirmed.wait(1.0)
    assert fake.state()["state"] == 4
    fake.faults(latency=0.0)
    late = [r for r in received if r["function"] == 93 and r["at"] > stops[0]["at"] + 0.2]
    assert not late, "nothing is sent after STOP"
    before = np.array(fake.state()["position"])
    cell.resume()
    assert cell.drive(FORWARD, 3) == 0
    targets = fake.servo_targets()
    assert np.linalg.norm(np.array(targets[0]["pose"][:3]) - before) < STEP, "from where it stands, no jump"
    assert steps(targets).max() < STEP


def test_only_resume_leads_out_of_a_stop(cell: Cell, fake: FakeXArm) -> None:
    cell.servo.stop("STOP")
    cell.until(lambda s: s.mode is RobotMode.LATCHED)
    assert cell.drive(FORWARD, 5) == 5
    time.sleep(0.1)
    fake.received()
    time.sleep(0.3)
    assert not fake.received(), "no servo target, no mode, no cleared error without the operator"


@pytest.mark.slow
def test_the_gripper_follows_without_stalling_the_servo_loop(cell: Cell, fake: FakeXArm) -> None:
    cell.go_home()
    writes, fake_at = fake.state()["gripper_writes"], fake.state()
    close = np.array((0, 0, 0, 0, 0, 0, 1.0))
    fake.received()
    cell.drive(close, 30)
    cell.drive(close + np.array((0, 0, 0, 0, 0, 0, -0.02)), 10)
    targets, state = fake.servo_targets(), fake.state()
    assert fake_at["gripper"] > 800 and state["gripper"] < 100
    assert state["gripper_writes"] - writes == 1, "told once; a change within the hysteresis is not told"
    assert state["gripper_speed"] == cell.rig.xarm.gripper.speed
    assert cell.servo.newest.measured.gripper < 0.1, "its opening is read back"
    assert np.percentile(np.diff([t["at"] for t in targets]), 95) < 0.02
    cell.go_home()
    assert cell.servo.newest.measured.gripper > 0.95


@pytest.mark.slow
def test_starting_leaves_what_the_hand_holds_in_the_hand(fake: FakeXArm) -> None:
    rig = rig_at(fake, FAKE_PORT)
    first = Cell(fake, rig)
    fake.tell(do="object", at=400)
    first.drive(np.array((0, 0, 0, 0, 0, 0, 1.0)), 30)
    first.close()
    second = Cell(fake, rig)
    time.sleep(0.5)
    assert 350 < fake.state()["gripper"] < 450
    fake.tell(do="object", at=None)
    second.go_home()
    second.close()


@pytest.mark.slow
def test_a_g2_gripper_is_told_millimetres(fake: FakeXArm) -> None:
    rig = rig_at(fake, FAKE_PORT)
    g2 = replace(rig.xarm.gripper, kind="g2", open=84.0, closed=0.0, speed=150.0, force=40.0)
    cell = Cell(fake, replace(rig, xarm=replace(rig.xarm, gripper=g2)))
    cell.drive(np.array((0, 0, 0, 0, 0, 0, 1.0)), 30)
    assert cell.servo.newest.measured.gripper < 0.1
    state = fake.state()
    assert state["gripper_force"] == 40
    assert state["gripper_speed"] == int((150 * 60 / 9.88235 + 140) / 0.4), "mm/s in the hand's own unit (SDK)"
    cell.drive(np.array((0, 0, 0, 0, 0, 0, -1.0)), 30)
    assert cell.servo.newest.measured.gripper > 0.9
    cell.close()


def test_a_controller_that_never_answers_is_an_error_in_time() -> None:
    listener = socket.create_server((loopback(), FAKE_PORT))
    rig = at_address(load_rig("xarm7"), f"{listener.getsockname()[0]}:{FAKE_PORT}")
    began = time.monotonic()
    with pytest.raises(RobotError, match="took the connection but did not answer within 1 s"):
        XArmPlant(replace(rig, xarm=replace(rig.xarm, connect_timeout=1.0)), TASK)
    assert time.monotonic() - began < 5
    listener.close()


def test_a_unix_socket_that_lies_about_is_never_taken_for_the_controller() -> None:
    """The SDK would prefer it to whatever address it was given."""
    listener = socket.create_server((loopback(), 0))
    address, port = listener.getsockname()
    trap = Path(f"/tmp/xarmcontroller_uds_{port}")
    with listener, socket.socket(socket.AF_UNIX) as beside:
        beside.bind(str(trap))
        beside.listen()
        beside.setblocking(False)
        listener.settimeout(5.0)
        settings = replace(load_rig("xarm7").xarm, address=address, port=port, connect_timeout=1.0)
        try:
            with pytest.raises(RobotError, match="took the connection but did not answer"):
                connect(settings, "none", 0.2)
            listener.accept()[0].close()
            with pytest.raises(BlockingIOError):
                beside.accept()
        finally:
            trap.unlink()


def test_no_controller_at_all_says_where_it_was_looked_for() -> None:
    address = loopback()
    with pytest.raises(RobotError, match=rf"no xArm controller at {address}:{FAKE_PORT}"):
        XArmPlant(at_address(load_rig("xarm7"), f"{address}:{FAKE_PORT}"), TASK)


def test_collision_detection_below_the_rigs_is_refused_not_changed(fake: FakeXArm) -> None:
    fake.tell(do="set", name="sensitivity", value=0)
    time.sleep(0.3)
    fake.received()
    try:
        with pytest.raises(RobotError, match="collision sensitivity is 0, the rig asks for at least 3"):
            XArmPlant(rig_at(fake, FAKE_PORT), TASK)
        assert Function.SET_COLLISION_SENSITIVITY not in {r["function"] for r in fake.received()}
    finally:
        fake.tell(do="set", name="sensitivity", value=3)


def test_a_tool_that_differs_is_set_before_servo_mode(fake: FakeXArm) -> None:
    fake.tell(do="set", name="load", value=[0.1, 0.0, 0.0, 0.0])
    time.sleep(0.3)
    fake.received()
    plant = XArmPlant(rig_at(fake, FAKE_PORT), TASK)
    functions = [r["function"] for r in fake.received()]
    assert functions.index(Function.SET_LOAD) < functions.index(Function.SET_MODE)
    assert not plant.measure().error
    plant.close()


def test_no_target_is_sent_to_a_controller_that_does_not_report_servo_mode_and_a_state_that_follows(
    fake: FakeXArm,
) -> None:
    fake.tell(do="set", name="emergency", value=1)  # its motors stay off, and it does not say why
    fake.received()
    try:
        with pytest.raises(RobotError, match=r"did not enter servo mode within 2 s \(it reports mode 1, state 4"):
            XArmPlant(rig_at(fake, FAKE_PORT), TASK)
        assert not fake.servo_targets()
    finally:
        fake.tell(do="set", name="emergency", value=0)


def test_a_rig_faster_than_its_servo_step_is_refused() -> None:
    rig = load_rig("xarm7")
    with pytest.raises(ConfigError, match=r"servo ticks of at most 0\.0025 m at 100 Hz allow 0\.25 m/s"):
        replace(rig, safety=replace(rig.safety, speed=0.4))


def test_a_latching_hold_stops_the_arm_at_its_controller_too(xarm: XArmBench) -> None:
    xarm.start(seed=1)
    xarm.drive(FORWARD, 6)
    xarm.robot.request(Hold(reason="STOP", latch=True))
    received = xarm.fake.received()
    assert [r for r in received if r["function"] == Function.SET_STATE and r["argument"] == 4]
    assert xarm.fake.state()["state"] == 4
    xarm.robot.request(Resume())
    assert xarm.fake.state()["mode"] == 1
    assert xarm.robot.observe().status.mode is RobotMode.HOLD


def test_no_thread_beside_stop_may_wait_for_a_core_while_it_holds_the_interpreter(xarm: XArmBench) -> None:
    """Those of the SDK included, also after it connected anew."""
    if xarm.server.handshake["scheduling"] != "fifo":
        pytest.skip("real time is not permitted here")
    xarm.fake.tell(do="cut")
    xarm.until(lambda o: o.status.fault)
    xarm.robot.request(Resume())
    threads = [int(path.name) for path in Path(f"/proc/{xarm.server.process.pid}/task").iterdir()]
    assert len(threads) > 10
    assert {os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK for thread in threads} == {os.SCHED_FIFO}
