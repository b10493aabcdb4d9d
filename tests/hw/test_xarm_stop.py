"""STOP's own connection on the fake controller: its frame gets there whatever became of the other connections."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator

import pytest

from hw.fake_xarm.control import FakeXArm
from hw.fake_xarm.protocol import Function
from hw.xarm7.plant import XArmPlant
from hw.xarm7.sdk import stream
from tests.hw.cell import TASK, rig_at
from tests.hw.conftest import FAKE_PORT, loopback

pytestmark = pytest.mark.filterwarnings("ignore:The 'warn' method is deprecated")  # the SDK's


@pytest.fixture
def fake() -> Iterator[FakeXArm]:
    fake = FakeXArm.start(loopback(), FAKE_PORT)
    yield fake
    fake.close()


@pytest.fixture
def plant(fake: FakeXArm) -> Iterator[XArmPlant]:
    plant = XArmPlant(rig_at(fake, FAKE_PORT), TASK)
    fake.received()
    yield plant
    plant.close()


def stops(fake: FakeXArm) -> list[dict]:
    return [r for r in fake.received() if r["function"] == Function.SET_STATE and r["argument"] == 4]


def test_stop_is_repeated_until_the_controller_confirms_it(plant: XArmPlant, fake: FakeXArm) -> None:
    fake.faults(mute=True)  # the first frames are lost on the way
    plant.halt()
    time.sleep(0.5)
    assert not plant.links.stop.confirmed.is_set() and not stops(fake)
    fake.faults(mute=False)
    assert plant.links.stop.confirmed.wait(2.0)
    assert stops(fake) and fake.state()["state"] == 4


def test_a_controller_that_goes_on_though_stopped_is_told_again(plant: XArmPlant, fake: FakeXArm) -> None:
    plant.halt()
    assert plant.links.stop.confirmed.wait(1.0)
    fake.tell(do="set", name="state", value=1)
    plant.halt()
    assert plant.links.stop.confirmed.wait(1.0) and fake.state()["state"] == 4


def test_without_its_connection_the_others_carry_the_frame(plant: XArmPlant, fake: FakeXArm) -> None:
    stream(plant.links.stop.api).shutdown(socket.SHUT_RDWR)
    deadline = time.monotonic() + 3.0
    while plant.links.stop.api.connected and time.monotonic() < deadline:
        time.sleep(0.01)
    assert "STOP" in plant.links.lost()
    fake.received()
    plant.halt()
    time.sleep(0.1)
    assert stops(fake) and fake.state()["state"] == 4
    assert not plant.links.stop.confirmed.is_set(), "nobody was there to hear it confirmed"


def test_the_frame_waits_for_no_lock_and_no_answer(plant: XArmPlant, fake: FakeXArm) -> None:
    """Each connection is as a call leaves it that waits for an answer; the plant's own lock is free then."""
    links = plant.links
    with contextlib.ExitStack() as stuck:
        for api in (links.motion, links.feedback, links.stop.api):
            stuck.enter_context(api._arm.arm_cmd.lock)
        halting = threading.Thread(target=plant.halt, daemon=True)
        halting.start()
        halting.join(5.0)
        assert not halting.is_alive() and stops(fake)
    assert links.stop.confirmed.wait(2.0)
