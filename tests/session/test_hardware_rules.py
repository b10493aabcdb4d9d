"""What a session on a real arm has beyond one on the twin: each rule fails here when it is taken away."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from far_app.cli.options import RunOptions
from far_app.cli.run import on_this_robot
from far_app.config import PerturbationConfig, RetryConfig
from far_app.errors import ConfigError
from far_app.protocols import Hold, Resume
from far_app.session_states import Intent, State
from tests.session.kinematic import Forward, KinematicRobot
from tests.session.test_session import Desk


def eventually(condition, what: str, limit: float = 10.0) -> None:
    deadline = time.monotonic() + limit
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.002)


def started(desk: Desk) -> threading.Thread:
    thread = threading.Thread(target=desk.session.run)
    thread.start()
    return thread


def test_before_each_trial_the_arm_waits_for_the_scene_and_nothing_but_scene_ready_goes_on():
    desk = Desk(headless=False, await_scene=True, trials=2)
    thread = started(desk)
    for trial in (1, 2):
        eventually(lambda: desk.state is State.AWAITING_SCENE, "it waits for the scene")
        sent = len(desk.robot.targets)
        desk.inbox.put(Intent.RESUME)
        desk.inbox.put(Intent.MARK_SUCCESS)
        time.sleep(0.2)
        assert desk.state is State.AWAITING_SCENE
        assert len(desk.robot.targets) == sent and isinstance(desk.robot.requests[-1], Hold)
        desk.inbox.put(Intent.SCENE_READY)
        eventually(lambda n=trial: len(desk.session.results) == n, "the trial runs")
    thread.join(5)
    assert desk.state is State.FINISHED


def test_a_stop_while_waiting_for_the_scene_asks_for_the_scene_again():
    desk = Desk(headless=False, await_scene=True)
    thread = started(desk)
    eventually(lambda: desk.state is State.AWAITING_SCENE, "it waits")
    desk.inbox.put(Intent.STOP)
    eventually(lambda: desk.state is State.STOPPED, "it stops")
    desk.inbox.put(Intent.RESUME)
    eventually(lambda: desk.state is State.AWAITING_SCENE, "a stop confirms nothing")
    assert not desk.session.results
    desk.inbox.put(Intent.QUIT)
    thread.join(5)
    assert desk.state is State.FINISHED and not desk.robot.targets


def test_each_attempt_is_announced_and_a_pause_cancels_the_countdown():
    desk = Desk(policy=Forward(speed=0.1), headless=False, countdown=0.5, attempts=2)
    thread = started(desk)
    eventually(lambda: "attempt 1 begins in 1 s" in desk.session.board.reason, "it is announced")
    desk.inbox.put(Intent.PAUSE)
    eventually(lambda: desk.state is State.PAUSED, "it is cancelled")
    time.sleep(0.7)
    assert desk.state is State.PAUSED and not desk.robot.targets
    desk.inbox.put(Intent.RESUME)
    resumed = time.monotonic()
    eventually(lambda: desk.robot.targets, "it goes on")
    assert time.monotonic() - resumed > 0.45, "announced anew"
    eventually(lambda: "attempt 2 begins" in desk.session.board.reason, "retries are announced too")
    desk.inbox.put(Intent.SKIP_TRIAL)
    thread.join(5)
    assert desk.state is State.FINISHED


def test_without_anyone_at_the_page_the_arm_is_held_until_resume():
    desk = Desk(policy=Forward(speed=0.02), headless=False, page_silence=0.3, horizon=200, attempts=1)
    stop_looking = threading.Event()

    def look():
        while not stop_looking.wait(0.05):
            desk.inbox.looked_at = time.monotonic()

    watcher = threading.Thread(target=look)
    watcher.start()
    thread = started(desk)
    eventually(desk.moving, "it moves while somebody looks")
    time.sleep(0.5)
    assert desk.state is State.RUNNING
    stop_looking.set()
    watcher.join()
    eventually(lambda: desk.state is State.PAUSED, "held")
    assert "nobody has had the page open" in desk.session.board.reason
    assert isinstance(desk.robot.requests[-1], Hold)
    desk.inbox.looked_at = time.monotonic()
    time.sleep(0.2)
    assert desk.state is State.PAUSED, "the page's return alone moves nothing"
    desk.inbox.looked_at = time.monotonic() + 60
    desk.inbox.put(Intent.RESUME)
    eventually(lambda: desk.state is State.RUNNING, "the operator resumes")
    desk.inbox.put(Intent.QUIT)
    thread.join(5)


def test_the_sessions_first_attempt_runs_slower_over_the_same_way_and_is_not_counted():
    desk = Desk(policy=Forward(speed=0.1), trials=2, attempts=1, horizon=20, first_stretch=2)
    desk.session.run()
    slow, fast = desk.session.results
    assert (slow.counted, fast.counted) == (False, True)
    x = np.array([t.pose.position[0] for t in desk.robot.targets])
    assert len(x) == 60, "twice the ticks, then the policy's own"
    np.testing.assert_allclose(np.diff(x[:40]), 0.5 * np.diff(x[40:]).mean(), rtol=1e-6)
    assert x[39] == pytest.approx(x[59], abs=1e-9), "the same way"
    assert [row.counted for row in desk.session.board.history.trials] == [False, True]


def test_a_way_home_that_asks_is_shown_and_answered_by_resume():
    desk = Desk(robot=KinematicRobot(homing_ticks=10**6), headless=False)
    thread = started(desk)
    eventually(lambda: desk.state is State.HOMING, "it goes home")
    assert Intent.RESUME not in desk.session.standing.allowed(), "nothing waits for an answer yet"
    desk.robot.status = replace(desk.robot.status, reason="take what the hand holds, then resume")
    eventually(lambda: "take what the hand holds" in desk.session.board.reason, "the page says what is waited for")
    desk.inbox.put(Intent.RESUME)
    eventually(lambda: any(isinstance(r, Resume) for r in desk.robot.requests), "the arm is told")
    desk.inbox.put(Intent.QUIT)
    thread.join(5)
    assert desk.state is State.FINISHED


def test_on_a_real_arm_perturbation_is_smoothed_and_of_x_y_z_unless_told_otherwise():
    retry = RetryConfig(perturbation=PerturbationConfig(sigma=0.2))
    assert on_this_robot(RunOptions(), retry) == retry, "the twin keeps the paper's"
    real = on_this_robot(RunOptions(robot="xarm"), retry).perturbation
    assert (real.kind, real.dims, real.sigma) == ("smoothed", (0, 1, 2), 0.2)


def test_a_real_arm_is_never_run_headless():
    with pytest.raises(ConfigError, match="somebody who watches its page"):
        RunOptions(robot="xarm", host="192.168.1.50", headless=True).load_rig()
    assert RunOptions(robot="xarm", host="127.0.0.1:15502", headless=True).load_rig().xarm.port == 15502


def test_robot_and_rig_file_must_agree():
    with pytest.raises(ConfigError, match="--robot is twin, but rig xarm7"):
        RunOptions(robot="twin", rig="xarm7").load_rig()
    with pytest.raises(ConfigError, match="has no controller to be reached"):
        RunOptions(host="192.168.1.50").load_rig()
