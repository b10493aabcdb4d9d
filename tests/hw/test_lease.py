"""One program leads an arm; a second is refused and told who does."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from far_app.errors import ArmTaken
from hw.fake_xarm.control import FakeXArm
from hw.lease import LAPSE, Lease, claim
from tests.hw.conftest import FAKE_PORT, HwProcess, XArmBench, loopback

ALICE, BOB = "alice@robot, process 1#a", "bob@gpu, process 2#b"


def test_the_first_who_asks_leads_until_it_leaves() -> None:
    lease = Lease()
    assert lease.ask(ALICE, 10.0) == ALICE
    assert lease.ask(BOB, 11.0) == ALICE
    lease.leave(BOB)
    assert lease.holder(11.0) == ALICE, "only its holder gives it up"
    lease.leave(ALICE)
    assert lease.ask(BOB, 11.0) == BOB


def test_who_falls_silent_leads_no_longer() -> None:
    lease = Lease()
    lease.ask(ALICE, 10.0)
    assert lease.ask(BOB, 10.0 + LAPSE) == ALICE
    lease.ask(ALICE, 12.0)
    assert lease.ask(BOB, 12.0 + LAPSE + 0.1) == BOB
    assert lease.ask(ALICE, 16.0) == BOB


def test_another_ones_messages_are_refused_and_told_who_leads() -> None:
    lease = Lease()
    assert lease.refusal(BOB, 10.0) == "", "an arm that nobody asked to lead"
    lease.ask(ALICE, 10.0)
    assert lease.refusal(ALICE, 10.0) == ""
    assert "led by alice@robot, process 1;" in lease.refusal(BOB, 10.0)


@pytest.fixture
def claimed() -> Iterator[str]:
    """An address whose controller another process drives."""
    address = loopback()
    words = f"from hw.lease import claim; claim({address!r}, {FAKE_PORT}); print(flush=True); input()"
    process = subprocess.Popen([sys.executable, "-c", words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    process.stdout.readline()
    yield address
    process.kill()
    process.communicate()


def test_a_controller_is_driven_by_one_process_of_a_machine(claimed: str) -> None:
    with pytest.raises(ArmTaken, match=rf"{claimed}:{FAKE_PORT} is driven by .*started by {os.getpid()}"):
        claim(claimed, FAKE_PORT)
    os.close(claim(claimed, FAKE_PORT + 1))


def test_the_death_of_its_holder_frees_a_controller() -> None:
    address = loopback()
    words = f"from hw.lease import claim; claim({address!r}, {FAKE_PORT})"
    subprocess.run([sys.executable, "-c", words], check=True)
    os.close(claim(address, FAKE_PORT))


def test_a_second_hw_server_is_refused_before_it_touches_the_arm(xarm: XArmBench, fake: FakeXArm) -> None:
    fake.received()
    connections = fake.state()["connections"]
    second = HwProcess("--rig", "xarm7", "--address", f"{fake.address}:{FAKE_PORT}")
    assert second.handshake["kind"] == "ArmTaken" and str(xarm.server.process.pid) in second.handshake["error"]
    second.close()
    assert fake.state()["connections"] == connections
    assert xarm.robot.observe().status.fault is False
