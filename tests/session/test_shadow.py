"""A shadow run plans and shows, and nothing that moves the arm leaves the app."""

from __future__ import annotations

import numpy as np
import pytest

from far_app.protocols import Heartbeat, Hold, Home, Reset, Resume
from far_app.session.shadow import ShadowRobot
from far_app.session.supervision import SessionFault
from far_app.session_states import State
from far_app.types import Target
from tests.session.kinematic import HOME, Forward, KinematicRobot
from tests.session.test_session import Desk


def test_only_hold_and_resume_go_through():
    inner = KinematicRobot()
    shadow = ShadowRobot(inner)
    for request in (Reset(seed=1), Home(), Heartbeat(), Hold(reason="x"), Resume()):
        shadow.request(request)
    assert [type(r) for r in inner.requests] == [Hold, Resume]
    shadow.send(Target(seq=7, pose=HOME, gripper=1.0, created=0.0, expires=1e12))
    assert inner.targets == []
    (ack,) = shadow.observe().acks
    assert ack.seq == 7 and "shadow" in ack.refused
    assert shadow.observe().acks == (), "handed out once"


def test_a_shadow_session_runs_to_the_horizon_and_sends_nothing():
    inner = KinematicRobot()
    desk = Desk(robot=ShadowRobot(inner), policy=Forward(speed=0.5), horizon=15, attempts=1)
    (result,) = desk.session.run()
    assert (result.success, result.judged_by) == (False, "horizon")
    assert inner.targets == [] and {type(r) for r in inner.requests} <= {Hold}
    assert np.array_equal(inner.pose.position, HOME.position)
    (attempt,) = desk.session.driver.attempts
    assert len(attempt.steps) == 15 and all(np.isnan(s.sent).all() for s in attempt.steps)
    assert all(s.commanded[0] == 0.5 for s in attempt.steps), "planned all the same"
    assert desk.statistics.overruns == 0


def test_the_path_is_shown_though_the_arm_stands():
    desk = Desk(robot=ShadowRobot(KinematicRobot()), policy=Forward(speed=0.5), horizon=15, attempts=1)
    shown = []
    stepped = desk.session.board.stepped

    def look(step):
        stepped(step)
        shown.append(desk.session.board.telemetry(desk.state, desk.session.robot.newest).chunk_path)

    desk.session.board.stepped = look  # type: ignore[method-assign]
    desk.session.run()
    path = shown[-1]
    assert path.shape == (8, 3) and np.all(np.diff(path[:, 0]) > 0.003)


def test_a_fault_of_the_arm_still_ends_a_shadow_run():
    inner = KinematicRobot()
    desk = Desk(robot=ShadowRobot(inner), policy=Forward(), horizon=200, attempts=1)
    desk.when(lambda: desk.state is State.RUNNING, lambda: inner.latch("the arm reports C31", fault=True))
    with pytest.raises(SessionFault, match="C31"):
        desk.session.run()
