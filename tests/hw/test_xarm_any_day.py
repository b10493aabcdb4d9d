"""A bad day at random: whatever the network, the operator and the policy do, no servo target jumps."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

import numpy as np
import pytest

from far_app.errors import RobotError
from far_app.motion import TargetIntegrator
from far_app.protocols import Heartbeat, Hold, Home
from far_app.types import RobotMode
from hw.controller import ArmController
from hw.fake_xarm.control import FakeXArm
from tests.hw.cell import TASK, Cell, rig_at, steps
from tests.hw.conftest import FAKE_PORT

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:The 'warn' method is deprecated")]  # the SDK's
SECONDS = 12.0
WELL = {"stall": 0.0, "latency": 0.0, "jitter": 0.0, "reports_stalled": False}
PRIMED = 60
"""Servo targets before the end of Resume that may be the arm's own pose, told to it before it is led again."""


@pytest.fixture
def cell(fake: FakeXArm) -> Iterator[Cell]:
    fake.received()
    cell = Cell(fake, rig_at(fake, FAKE_PORT))
    yield cell
    fake.faults(**WELL)
    cell.close()


def mishap(cell: Cell, rng: np.random.Generator) -> float:
    """One of what happens; returns seconds for which the app is then silent."""
    kind = rng.integers(6)
    if kind == 0:
        cell.fake.faults(stall=float(rng.uniform(0.02, 0.3)), stall_every=30.0, stall_in=0.05)
    elif kind == 1:
        cell.fake.faults(latency=float(rng.uniform(0.0, 0.008)), jitter=float(rng.uniform(0.0, 0.01)))
    elif kind == 2:
        cell.fake.faults(reports_stalled=True)
    elif kind == 3:
        with contextlib.suppress(RobotError):  # latched
            cell.request(Home())
    elif kind == 4:
        cell.request(Hold(reason="pause", latch=bool(rng.random() < 0.3)))
    elif kind == 5:
        return float(rng.uniform(0.05, 0.5))
    return 0.0


@pytest.mark.parametrize("seed", range(2))
def test_no_servo_target_jumps_on_any_day(
    cell: Cell, fake: FakeXArm, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    anew, resumed, start_anew = [], [], ArmController._start_anew

    def noted(controller: ArmController) -> None:
        anew.append(time.monotonic())
        start_anew(controller)

    monkeypatch.setattr(ArmController, "_start_anew", noted)
    cell.go_home()
    fake.received()
    integrator = TargetIntegrator(cell.rig.scale, cell.servo.newest.measured.eef)
    action, silent_until = np.zeros(7), 0.0
    due = time.monotonic()
    end = due + SECONDS
    while (now := time.monotonic()) < end:
        if rng.random() < 0.03:
            silent_until = now + mishap(cell, rng)
        if rng.random() < 0.03:
            fake.faults(**WELL)
        if rng.random() < 0.07:
            action = np.append(rng.uniform(-1, 1, 6), -1.0)
        mode = cell.status.mode
        if mode is RobotMode.LATCHED and rng.random() < 0.1:
            fake.faults(**WELL)
            with contextlib.suppress(RobotError):  # not yet
                cell.resume()
            resumed.append(time.monotonic())
            integrator = TargetIntegrator(cell.rig.scale, cell.servo.newest.measured.eef)
        elif mode is RobotMode.HOMING and now > silent_until:
            cell.request(Heartbeat())
            integrator = TargetIntegrator(cell.rig.scale, cell.servo.newest.measured.eef)
        elif now > silent_until:
            target = integrator.target(action, cell.servo.newest.measured.eef, time.monotonic())
            with cell.servo.locked() as controller:
                controller.offer(target, time.monotonic())
                for ack in controller.take_acks():
                    integrator.executed(ack)
        due += 1 / TASK.rate
        time.sleep(max(0.0, due - time.monotonic()))
    targets = fake.servo_targets()
    position, at = np.array([t["pose"][:3] for t in targets]) / 1e3, np.array([t["at"] for t in targets])
    change = np.linalg.norm(np.diff(position, n=2, axis=0), axis=1) / 0.01**2
    rested = np.isin(np.arange(len(change)), np.searchsorted(at, anew) - 2)
    for last in np.searchsorted(at, resumed):
        rested[max(0, last - PRIMED) : last + 1] = True
    assert len(targets) > 20 * SECONDS
    assert 1.0 < steps(targets).max() < 2.5 + 1e-3
    assert change[~rested].max() < 1.05 * cell.rig.safety.acceleration, "m/s², at 100 Hz"
