"""The way home of a real arm on the fake controller: how it lets go, what it may not do, and that it stops anywhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from far_app.errors import RobotError
from far_app.protocols import Hold, Home, Resume
from far_app.types import RobotMode
from hw.fake_xarm.control import FakeXArm
from hw.homing import CONTACT_LAG, LOWER_AT_MOST
from tests.hw.cell import BACK, FORWARD, TASK, Cell, rig_at, steps
from tests.hw.conftest import FAKE_PORT

pytestmark = pytest.mark.filterwarnings("ignore:The 'warn' method is deprecated")  # the SDK's
STEP = 2.5 + 1e-3
HELD = 400.0
"""Gripper position at which the fingers meet what the hand holds."""
CLOSED = np.array((0, 0, 0, 0, 0, 0, 2.0))
"""Added to a motion that opens: the hand closes."""


@contextmanager
def holding(fake: FakeXArm, release: str, speed: float = 0.25) -> Iterator[Cell]:
    """An arm some centimetres from home with something in its hand, and a task that lets go so. Home at this speed,
    m/s."""
    rig = rig_at(fake, FAKE_PORT)
    cell = Cell(fake, replace(rig, home=replace(rig.home, speed=speed)), replace(TASK, release=release))
    try:
        cell.go_home()
        fake.tell(do="object", at=HELD)
        cell.drive(FORWARD + CLOSED, 12)
        cell.drive(0 * FORWARD + CLOSED / 2, 20)
        fake.received()
        yield cell
    finally:
        fake.tell(do="object", at=None)
        fake.tell(do="set", name="floor", value=-1e9)
        cell.close()


def path(fake: FakeXArm) -> np.ndarray:
    """Servo targets since last asked, millimetres (n, 3)."""
    return np.array([t["pose"][:3] for t in fake.servo_targets()]).reshape(-1, 3)


def test_a_task_that_asks_holds_the_arm_and_what_it_holds_until_the_operator_resumes(fake: FakeXArm) -> None:
    with holding(fake, "ask") as cell:
        stood = np.array(fake.state()["position"])
        cell.request(Home())
        began = time.monotonic()
        cell.beat_until(lambda s: time.monotonic() > began + 1.5)
        assert cell.status.mode is RobotMode.HOMING and "take what the hand holds" in cell.status.reason
        assert fake.state()["gripper"] == pytest.approx(HELD, abs=5)
        assert np.abs(path(fake) - stood).max() < 0.1
        cell.request(Resume())
        cell.beat_until(lambda s: s.at_home)
        assert fake.state()["gripper"] > 800 and cell.status.reason == ""


def test_lower_then_open_lets_go_where_it_stands_on_something(fake: FakeXArm) -> None:
    with holding(fake, "lower_then_open") as cell:
        floor = fake.state()["position"][2] - 60.0
        fake.tell(do="set", name="floor", value=floor)
        cell.request(Home())
        gripper = after_each(cell, fake, lambda s: s.at_home)
        let_go = next(z for z, opening in gripper if opening > HELD + 20)
        assert let_go == pytest.approx(floor, abs=1.0), "not before it stands, and not higher"
        lowest = path(fake)[:, 2].min()
        assert floor - 1e3 * CONTACT_LAG - 5 < lowest < floor, "it presses no further than it takes to feel it"


def test_lower_then_open_goes_down_a_set_way_at_most_and_never_below_the_box(fake: FakeXArm) -> None:
    with holding(fake, "lower_then_open") as cell:
        height = fake.state()["position"][2]
        cell.request(Home())
        cell.beat_until(lambda s: s.at_home, 15.0)
        lowest = path(fake)[:, 2].min()
        assert lowest == pytest.approx(max(height - 1e3 * LOWER_AT_MOST, 1e3 * cell.rig.safety.box_min[2]), abs=1.0)


def test_open_lets_go_before_the_arm_moves_and_the_way_home_is_slow(fake: FakeXArm) -> None:
    with holding(fake, "open", speed=0.1) as cell:
        stood = np.array(fake.state()["position"])
        cell.request(Home())
        seen = after_each(cell, fake, lambda s: s.at_home)
        moved = next(opening for z, opening in seen if z > stood[2] + 2.0)
        assert moved > 800
        fastest = 100.0 * steps(fake.servo_targets()).max() / 1e3
        assert 0.5 * cell.rig.home.speed < fastest < 1.05 * cell.rig.home.speed < cell.rig.safety.speed


@pytest.mark.parametrize(("how", "progress"), [("STOP", 0.15), ("STOP", 0.3), ("STOP", 0.6), ("hold", 0.6)],
                         ids=["letting go", "retreating", "returning", "a hold"])  # fmt: skip
def test_the_way_home_stops_anywhere_and_goes_on_from_where_the_arm_stands(
    fake: FakeXArm, how: str, progress: float
) -> None:
    with holding(fake, "open") as cell:
        cell.request(Home())
        cell.beat_until(lambda s: s.homing_progress >= progress)
        if how == "STOP":
            cell.servo.stop("STOP")
            cell.until(lambda s: s.mode is RobotMode.LATCHED)
        else:
            cell.request(Hold(reason="paused"))
        time.sleep(0.3)
        stood = np.array(fake.state()["position"])
        fake.received()
        time.sleep(0.3)
        assert steps(fake.servo_targets()).max(initial=0.0) == 0.0
        np.testing.assert_allclose(fake.state()["position"], stood, atol=0.01)
        assert not cell.status.at_home
        if how == "STOP":
            cell.resume()
        fake.received()
        cell.go_home()
        targets = fake.servo_targets()
        assert np.linalg.norm(np.array(targets[0]["pose"][:3]) - stood) < STEP and steps(targets).max() < STEP


def test_without_heartbeats_the_way_home_stands_still(fake: FakeXArm) -> None:
    with holding(fake, "open") as cell:
        cell.request(Home())
        cell.beat_until(lambda s: s.homing_progress >= 0.6)
        time.sleep(0.3)
        fake.received()
        time.sleep(0.3)
        assert steps(fake.servo_targets()).max(initial=0.0) == 0.0
        assert "no heartbeat for 100 ms" in cell.status.reason
        cell.beat_until(lambda s: s.at_home)


def test_a_way_home_that_leaves_the_box_is_refused_before_anything_moves(fake: FakeXArm) -> None:
    rig = rig_at(fake, FAKE_PORT)
    low, high = rig.safety.box_min, rig.safety.box_max
    narrow = replace(rig.safety, box_max=(rig.start_position[0] - 0.01, *high[1:]), box_min=(low[0] - 0.2, *low[1:]))
    cell = Cell(fake, rig)
    try:
        cell.go_home()
        cell.drive(BACK, 25)
    finally:
        cell.close()
    cell = Cell(fake, replace(rig, safety=narrow))
    try:
        time.sleep(0.2)
        fake.received()
        with pytest.raises(RobotError, match=r"Home refused: the path home leaves the workspace box at \("):
            cell.request(Home())
        time.sleep(0.2)
        assert cell.status.mode is RobotMode.HOLD
        assert steps(fake.servo_targets()).max(initial=0.0) == 0.0
    finally:
        cell.close()


def after_each(cell: Cell, fake: FakeXArm, what: Callable) -> list[tuple[float, float]]:
    """Height and gripper position (the wire's units) at each heartbeat until a status shows it."""
    seen: list[tuple[float, float]] = []

    def look(status) -> bool:
        state = fake.state()
        seen.append((state["position"][2], state["gripper"]))
        return what(status)

    cell.beat_until(look, 15.0)
    return seen
