"""The real-time session against a robot whose misbehaviour the test sets. Rates are raised so that trials are short."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from far_app.detectors import PersonJudge, TwinCheck
from far_app.errors import RecordingError
from far_app.motion import ActionScale
from far_app.protocols import EngineReport, Hold, Home, Resume
from far_app.recording.inspect import inspect_session
from far_app.recording.schema import SessionInfo
from far_app.recording.writer import SessionWriter
from far_app.session.adaptation import unchanged
from far_app.session.inbox import IntentInbox
from far_app.session.planners import ThreadedPlanner
from far_app.session.recorder import Recorder
from far_app.session.session import Session
from far_app.session.settings import Freshness, SessionSettings
from far_app.session.statistics import LoopStatistics
from far_app.session.supervision import SessionFault
from far_app.session_states import Intent, State
from far_app.tasks import task
from far_app.types import Judge
from tests.session.kinematic import Faster, Forward, KinematicRobot


class Desk:
    """A session with everything a test may want to touch."""

    def __init__(self, robot=None, policy=None, adapting_seconds=0.0, horizon=20, attempts=3, detector=None,
                 writer=None, method=None, course=None, **settings) -> None:  # fmt: skip
        self.robot = robot or KinematicRobot()
        self.method = method or Faster(policy or Forward(), adapting_seconds)
        self.inbox = IntentInbox()
        self.statistics = LoopStatistics()
        settings = {"name": "test", "trials": 1, "seed": 5, "headless": True} | settings
        self.session = Session(
            settings=SessionSettings(**settings), robot=self.robot, planner=ThreadedPlanner(), method=self.method,
            detector=detector or TwinCheck(2), scale=ActionScale(), recorder=Recorder(writer), inbox=self.inbox,
            task=replace(task("lift"), horizon=horizon, max_attempts=attempts, rate=50.0), statistics=self.statistics,
            course=course,
        )  # fmt: skip

    @property
    def state(self) -> State:
        return self.session.standing.state

    def when(self, condition, act) -> None:
        """In a thread: as soon as the condition holds, act."""

        def wait():
            deadline = time.monotonic() + 20
            while time.monotonic() < deadline:
                if condition():
                    return act()
                time.sleep(0.002)
            return None

        threading.Thread(target=wait, daemon=True).start()

    def moving(self) -> bool:
        return self.state is State.RUNNING and len(self.robot.targets) > 3


def test_a_trial_succeeds_with_no_button_and_the_arm_is_held_at_the_end():
    desk = Desk()
    (result,) = desk.session.run()
    assert (result.seed, result.attempts, result.success, result.judged_by) == (5, 1, True, "twin")
    assert desk.state is State.FINISHED
    assert isinstance(desk.robot.requests[-1], Hold)
    assert desk.statistics.ticks >= len(desk.robot.targets) > 10
    assert len(desk.statistics.late) >= desk.statistics.ticks - 1
    assert not desk.session.driver.attempts[0].steps[0].starved, "the first chunk is there before the first tick"


def test_a_failure_is_adapted_from_in_the_background_and_the_retry_runs_the_new_version():
    desk = Desk(policy=Forward(speed=0.1))
    (result,) = desk.session.run()
    assert result.success and result.attempts == 3
    assert desk.method.adapted_attempts == [1, 2]
    versions = [a.policy_version for a in desk.session.driver.attempts]
    assert versions == ["forward-0", "forward-0+1", "forward-0+1+2"]
    assert desk.method.policy.version == "forward-0", "the base policy returns at the trial's end"


def test_a_slow_policy_never_blocks_a_tick():
    desk = Desk(policy=Forward(speed=0.1, seconds=0.07), horizon=40, attempts=1)
    desk.session.run()
    steps = desk.session.driver.attempts[0].steps
    assert len(steps) == 40
    assert sum(s.tick - s.chunk_tick >= 3 for s in steps) > 20, "the newest valid plan continues"
    deadlines = np.diff([s.deadline for s in steps])
    assert np.median(deadlines) < 0.03, "ticks go on at their own pace"


def test_an_adaptation_over_its_limit_is_cancelled_and_the_previous_version_retries():
    desk = Desk(policy=Forward(speed=0.1), adapting_seconds=30.0, attempts=2, adaptation_limit=0.1)
    began = time.monotonic()
    desk.session.run()
    assert time.monotonic() - began < 10
    assert [a.status for a in desk.session.lessons.learnt] == ["timeout"]
    assert [a.policy_version for a in desk.session.driver.attempts] == ["forward-0", "forward-0"]


def test_pause_holds_the_arm_and_resume_starts_from_the_measured_pose():
    desk = Desk(headless=False)
    seen = {}

    def pause():
        desk.inbox.put(Intent.PAUSE)
        desk.when(lambda: desk.state is State.PAUSED, disturb)

    def disturb():
        time.sleep(0.1)
        seen["targets"] = len(desk.robot.targets)
        moved = desk.robot.pose.position + np.array([-0.02, 0.03, 0.0])
        desk.robot.pose = replace(desk.robot.pose, position=moved)  # someone pushes the arm
        seen["pose"] = moved
        time.sleep(0.1)
        assert len(desk.robot.targets) == seen["targets"], "no target while paused"
        desk.inbox.put(Intent.RESUME)

    desk.when(desk.moving, pause)
    (result,) = desk.session.run()
    assert result.success
    assert any(isinstance(r, Hold) and "paused" in r.reason for r in desk.robot.requests)
    first = desk.robot.targets[seen["targets"]]
    assert np.linalg.norm(first.pose.position - seen["pose"]) <= ActionScale().translation + 1e-9


def test_stop_ends_the_attempt_and_only_resume_goes_on():
    desk = Desk(headless=False, attempts=2)

    def resume():
        time.sleep(0.2)
        assert desk.state is State.STOPPED
        desk.inbox.put(Intent.SKIP_TRIAL)
        time.sleep(0.1)
        assert desk.state is State.STOPPED and "resume first" in desk.session.board.refusal
        desk.inbox.put(Intent.RESUME)

    desk.when(desk.moving, lambda: desk.inbox.put(Intent.STOP))
    desk.when(lambda: desk.state is State.STOPPED, resume)
    (result,) = desk.session.run()
    assert result.success and result.attempts == 2
    stopped = desk.session.driver.attempts[0].outcome
    assert not stopped.success and stopped.judged_by is Judge.OPERATOR and "STOP" in stopped.note
    assert desk.method.adapted_attempts == [], "a stop teaches nothing"
    kinds = [type(r) for r in desk.robot.requests]
    assert kinds.index(Resume) < len(kinds) - 1 - kinds[::-1].index(Home)


def test_a_latch_of_the_hw_server_stops_the_session_even_on_the_way_home():
    desk = Desk(robot=KinematicRobot(homing_ticks=60), headless=False)
    desk.when(lambda: desk.state is State.HOMING and desk.robot.status.mode == "homing",
              lambda: desk.robot.latch("STOP pressed"))  # fmt: skip
    desk.when(lambda: desk.state is State.STOPPED, lambda: (time.sleep(0.1), desk.inbox.put(Intent.RESUME)))
    (result,) = desk.session.run()
    assert result.success and result.attempts == 1
    assert sum(isinstance(r, Home) for r in desk.robot.requests) == 2, "the way home is asked for again"


@pytest.mark.parametrize("intent, success", [(Intent.MARK_SUCCESS, True), (Intent.MARK_FAILURE, False)])
def test_the_operators_word_ends_an_attempt(intent, success):
    desk = Desk(policy=Forward(speed=0.01), horizon=500, attempts=1, headless=False)
    desk.when(desk.moving, lambda: desk.inbox.put(intent))
    (result,) = desk.session.run()
    assert result.success is success and result.judged_by == "operator"


def test_marking_success_while_adapting_cancels_the_adaptation_and_ends_the_trial():
    desk = Desk(policy=Forward(speed=0.01), horizon=5, adapting_seconds=30.0, headless=False)
    desk.when(lambda: desk.state is State.ADAPTING, lambda: desk.inbox.put(Intent.MARK_SUCCESS))
    began = time.monotonic()
    (result,) = desk.session.run()
    assert time.monotonic() - began < 10
    assert result.success and result.judged_by == "operator" and result.attempts == 1


def test_skip_ends_the_trial_without_a_retry():
    desk = Desk(policy=Forward(speed=0.01), horizon=500, headless=False, trials=2)
    desk.when(desk.moving, lambda: desk.inbox.put(Intent.SKIP_TRIAL))
    desk.when(lambda: desk.session.board.trial == 2 and desk.moving(), lambda: desk.inbox.put(Intent.QUIT))
    first, second = desk.session.run()
    assert (first.attempts, first.success, first.judged_by) == (1, False, "operator")
    assert second.attempts == 0, "an attempt cut off by quitting has no outcome"
    assert desk.method.adapted_attempts == []


def test_observations_stale_for_a_moment_hold_the_arm_and_motion_resumes_by_itself():
    desk = Desk(policy=Forward(speed=0.01), horizon=150, attempts=1)

    def stall():
        desk.robot.freeze_stamp = time.monotonic()
        time.sleep(0.5)
        desk.robot.freeze_stamp = None

    desk.when(desk.moving, stall)
    (result,) = desk.session.run()
    assert result.judged_by in ("twin", "horizon")
    assert desk.statistics.stale_holds == 1
    assert any(isinstance(r, Hold) and "stale" in r.reason for r in desk.robot.requests)


@pytest.mark.parametrize("trouble", ["stale", "silent", "arm", "nan"])
def test_trouble_is_a_fault_that_ends_a_headless_session_with_an_error(trouble):
    desk = Desk(policy=Forward(speed=0.01, poison=8 if trouble == "nan" else None), horizon=1000,
                freshness=Freshness(limit=0.3))  # fmt: skip

    def strike():
        if trouble == "stale":
            desk.robot.freeze_stamp = time.monotonic()
        elif trouble == "silent":
            desk.robot.silent = True
        elif trouble == "arm":
            desk.robot.latch("arm error C31: collision", fault=True)

    desk.when(desk.moving, strike)
    message = {
        "stale": "observations were stale",
        "silent": "hardware server",
        "arm": "C31",
        "nan": "non-finite action",
    }
    with pytest.raises(SessionFault, match=message[trouble]):
        desk.session.run()
    (attempt,) = desk.session.driver.attempts
    assert attempt.outcome.judged_by is Judge.FAULT and len(attempt.steps) > 3
    (result,) = desk.session.results
    assert not result.success and result.judged_by == "fault"


def test_an_operator_clears_a_fault_and_the_trial_goes_on():
    desk = Desk(headless=False, attempts=2)
    desk.when(desk.moving, lambda: desk.robot.latch("arm error C31: collision", fault=True))
    desk.when(lambda: desk.state is State.FAULT, lambda: (time.sleep(0.1), desk.inbox.put(Intent.RESUME)))
    (result,) = desk.session.run()
    assert result.success and result.attempts == 2
    assert desk.method.adapted_attempts == [1], "an arm fault is a failure to learn from"


def test_the_page_sees_the_flags_while_the_arm_goes_home():
    class Telling(Faster):
        def adapt(self, attempt, cancelled, progress):
            known = unchanged(self.policy.version, "none")
            progress(replace(known, values=np.zeros(6), value_changes=np.array([0.0, -1.0]), flagged=(1,)))
            time.sleep(0.2)
            return replace(known, status="empty", flagged=(1,))

    desk = Desk(method=Telling(Forward(speed=0.01)), horizon=5, attempts=2)
    shown = []
    desk.session.standing.show = lambda: shown.append(desk.session.board.telemetry(desk.state, None))
    desk.session.run()
    adapting = [t for t in shown if t.state is State.ADAPTING]
    assert any(t.flagged == (1,) and t.adaptation_status == "candidates" and len(t.values) == 6 for t in adapting)
    retry = [t for t in shown if t.state is State.RUNNING and t.attempt == 2]
    assert all(t.flagged == () for t in retry), "a new attempt starts with a clean curve"
    assert all(t.adaptation_status == "empty" for t in retry), "what was learnt stays on show"


def test_a_full_disk_ends_the_session_with_the_arm_held_and_what_was_recorded_readable(tmp_path):
    writer = SessionWriter(tmp_path, SessionInfo(task="lift", method="test"), space_to_start=0, space_to_go_on=10**18)
    desk = Desk(policy=Forward(speed=0.01), horizon=10, writer=writer)
    with pytest.raises(RecordingError, match="free"):
        desk.session.run()
    assert isinstance(desk.robot.requests[-1], Hold)
    assert inspect_session(writer.folder).state == "failed"


def test_a_person_judges_after_the_horizon_with_the_arm_held():
    desk = Desk(policy=Forward(speed=0.1), horizon=10, attempts=1, detector=PersonJudge(20.0), headless=False)
    desk.when(lambda: "success or failure?" in desk.session.board.reason,
              lambda: desk.inbox.put(Intent.MARK_SUCCESS))  # fmt: skip
    (result,) = desk.session.run()
    assert (result.success, result.judged_by) == (True, "operator")
    assert any(isinstance(r, Hold) and "waiting for the operator" in r.reason for r in desk.robot.requests)
    assert len(desk.session.driver.attempts[0].steps) == 10, "judging uses none of the horizon's ticks"


def test_a_person_who_says_nothing_within_the_time_means_failure():
    desk = Desk(policy=Forward(speed=0.1), horizon=10, attempts=2, detector=PersonJudge(0.3), headless=False)
    began = time.monotonic()
    (result,) = desk.session.run()
    assert (result.success, result.judged_by, result.attempts) == (False, "horizon", 2)
    assert time.monotonic() - began > 0.6


def test_stop_while_a_person_is_asked_ends_the_attempt():
    desk = Desk(policy=Forward(speed=0.1), horizon=10, attempts=1, detector=PersonJudge(20.0), headless=False)
    desk.when(lambda: "success or failure?" in desk.session.board.reason, lambda: desk.inbox.put(Intent.STOP))
    desk.when(lambda: desk.state is State.STOPPED, lambda: desk.inbox.put(Intent.RESUME))
    (result,) = desk.session.run()
    assert (result.success, result.judged_by) == (False, "operator")


def test_what_runs_the_policy_is_shown_and_a_refused_engine_is_told_once():
    class OnEngine(Forward):
        runs_on = EngineReport(name="arranged", why="fastest here", refused=("openvino: it differs by 0.1",))

    desk = Desk(policy=OnEngine(), trials=2)
    desk.session.run()
    shown = desk.session.board.telemetry(desk.state, None)
    assert (shown.engine, shown.engine_refused) == ("arranged", ("openvino: it differs by 0.1",))
    told = [line for line in shown.log if "refused" in line.text]
    assert [line.level for line in told] == ["warning"]
    assert told[0].text == "engine refused, openvino: it differs by 0.1; arranged runs the policy"
