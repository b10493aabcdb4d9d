"""Whatever goes wrong with a real arm ends in a held arm, words for the operator, and Resume without a jump."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from far_app.errors import RobotError
from far_app.types import RobotMode, RobotStatus
from hw.fake_xarm.control import FakeXArm
from hw.fake_xarm.protocol import Function
from tests.hw.cell import BACK, FORWARD, Cell, rig_at, steps
from tests.hw.conftest import FAKE_PORT, loopback

pytestmark = pytest.mark.filterwarnings("ignore:The 'warn' method is deprecated")  # the SDK's
STEP = 2.5 + 1e-3


@pytest.fixture
def fake() -> Iterator[FakeXArm]:
    """One of each test's own: faults leave traces."""
    fake = FakeXArm.start(loopback(), FAKE_PORT)
    yield fake
    fake.close()


@pytest.fixture
def cell(fake: FakeXArm) -> Iterator[Cell]:
    cell = Cell(fake, rig_at(fake, FAKE_PORT))
    yield cell
    cell.close()


def while_driving(cell: Cell, act: Callable[[], object]) -> RobotStatus:
    """Acts in the middle of a motion; returns the status once the arm is latched by a fault."""
    cell.drive(FORWARD, 6)
    thread = threading.Thread(target=act)
    thread.start()
    cell.drive(FORWARD, 60, until_held=True)
    thread.join()
    return cell.until(lambda s: s.mode is RobotMode.LATCHED)


def resumes_without_a_jump(cell: Cell) -> None:
    """Resume, then targets are followed from where the arm stands, step by step."""
    cell.fake.received()
    before = np.array(cell.fake.state()["position"])
    cell.resume()
    assert cell.status.mode is RobotMode.HOLD
    assert cell.drive(BACK, 6) == 0
    targets = cell.fake.servo_targets()
    assert np.linalg.norm(np.array(targets[0]["pose"][:3]) - before) < STEP
    assert steps(targets).max() < STEP
    there = np.array(cell.fake.state()["position"])
    assert np.linalg.norm(there - before) > 2.0, "it moves again"
    measured = cell.servo.newest.measured.eef.position
    assert np.linalg.norm(1e3 * measured - there) < 15.0, "and is seen to: the SDK's own pose freezes after C1 to C17"


@pytest.mark.parametrize(
    ("code", "words"), [(31, "C31: Collision"), (24, "C24: "), (35, "C35: "), (60, "C60: "), (2, "C2: ")]
)
def test_an_error_of_the_arm_is_told_in_the_vendors_words_and_cleared_by_the_operator_alone(
    cell: Cell, fake: FakeXArm, code: int, words: str
) -> None:
    status = while_driving(cell, lambda: fake.error(code))
    assert status.fault
    assert words in status.reason
    fake.received()
    time.sleep(0.5)
    assert not fake.received(), "nothing is cleared, enabled or sent without the operator"
    assert fake.state()["error"] == code
    resumes_without_a_jump(cell)
    assert fake.state()["error"] == 0


def test_a_pressed_emergency_stop_stays_until_it_is_released(cell: Cell, fake: FakeXArm) -> None:
    status = while_driving(cell, lambda: fake.tell(do="press", code=1))
    time.sleep(0.3)  # the gripper's thread meets the error meanwhile
    assert "C1: The Emergency Stop Button" in status.reason
    with pytest.raises(RobotError, match="still reports C1"):
        cell.resume()
    assert cell.status.mode is RobotMode.LATCHED
    fake.tell(do="release")
    resumes_without_a_jump(cell)


def test_an_error_from_before_the_start_waits_for_the_operator(fake: FakeXArm) -> None:
    fake.error(22)
    cell = Cell(fake, rig_at(fake, FAKE_PORT))
    status = cell.until(lambda s: s.fault)
    assert "C22" in status.reason
    functions = {r["function"] for r in fake.received()}
    assert not functions & {Function.CLEAN_ERR, Function.MOTION_EN, Function.MOVE_SERVO_CART_AA}
    resumes_without_a_jump(cell)
    cell.close()


@pytest.mark.parametrize("how", [{"do": "cut"}, {"do": "cut", "reset": True},
                                  pytest.param({"do": "restart", "seconds": 0.5}, marks=pytest.mark.slow)],
                         ids=["FIN", "RST", "restart"])  # fmt: skip
def test_a_lost_connection_is_a_fault_and_resume_connects_anew(cell: Cell, fake: FakeXArm, how: dict) -> None:
    status = while_driving(cell, lambda: fake.tell(**how))
    assert status.fault
    assert "connection to the controller" in status.reason and "press Resume" in status.reason
    time.sleep(0.8)
    resumes_without_a_jump(cell)


def test_a_controller_that_is_still_away_refuses_resume_in_words(cell: Cell, fake: FakeXArm) -> None:
    while_driving(cell, lambda: fake.tell(do="restart", seconds=30))
    with pytest.raises(RobotError, match="no xArm controller at"):
        cell.resume()
    assert cell.status.mode is RobotMode.LATCHED
    with pytest.raises(RobotError, match="no xArm controller at"):
        cell.resume()  # and again: a failed attempt leaves nothing half open


def test_a_silent_link_holds_at_once_and_is_a_fault_soon(cell: Cell, fake: FakeXArm) -> None:
    cell.drive(FORWARD, 6)
    fake.faults(mute=True)
    began = time.monotonic()
    refused = cell.drive(FORWARD, 60, until_held=True)
    held = time.monotonic() - began
    assert refused and held < 0.6
    status = cell.until(lambda s: s.fault)
    assert time.monotonic() - began < 2.5
    assert "the link is silent" in status.reason or "has not reported its pose" in status.reason
    fake.faults(mute=False)
    resumes_without_a_jump(cell)


def test_stalled_reports_hold_at_once_and_are_a_fault_soon(cell: Cell, fake: FakeXArm) -> None:
    cell.drive(FORWARD, 6)
    fake.faults(reports_stalled=True)
    assert cell.drive(FORWARD, 30, until_held=True)
    assert "ms old" in cell.status.reason
    status = cell.until(lambda s: s.fault)
    assert "has not reported its pose" in status.reason
    fake.faults(reports_stalled=False)
    time.sleep(0.3)
    resumes_without_a_jump(cell)


def test_a_short_pause_of_the_reports_is_a_hold_that_ends_by_itself(cell: Cell, fake: FakeXArm) -> None:
    cell.drive(FORWARD, 6)
    fake.faults(reports_stalled=True)
    assert cell.drive(FORWARD, 30, until_held=True)
    fake.faults(reports_stalled=False)
    time.sleep(0.1)
    fake.received()
    assert cell.drive(FORWARD, 10) == 0
    assert steps(fake.servo_targets()).max() < STEP
    assert cell.status.holds > 0


def test_a_slow_network_is_a_fault_that_tells_how_slow(cell: Cell, fake: FakeXArm) -> None:
    fake.received()
    status = while_driving(cell, lambda: fake.faults(latency=0.03, jitter=0.01))
    assert "answers servo calls in" in status.reason and "limit 15 ms" in status.reason
    assert steps(fake.servo_targets()).max() < STEP
    fake.faults(latency=0.0, jitter=0.0)
    resumes_without_a_jump(cell)


def test_someone_else_at_the_controller_is_a_fault(cell: Cell, fake: FakeXArm) -> None:
    status = while_driving(cell, lambda: fake.tell(do="set", name="mode", value=0))
    assert "left servo mode (it reports mode 0" in status.reason
    resumes_without_a_jump(cell)


def test_stop_while_the_arm_is_made_ready_wins(cell: Cell, fake: FakeXArm) -> None:
    while_driving(cell, lambda: fake.error(31))
    fake.faults(latency=0.04)
    resuming = cell.servo.resume()
    time.sleep(0.15)
    cell.servo.stop("STOP")
    with pytest.raises(RobotError, match="STOP"):
        resuming.result(timeout=15)
    fake.faults(latency=0.0)
    cell.until(lambda s: s.mode is RobotMode.LATCHED)
    time.sleep(0.2)
    assert fake.state()["state"] == 4
    resumes_without_a_jump(cell)
