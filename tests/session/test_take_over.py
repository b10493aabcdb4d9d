"""Taking over and handing back in the real-time session: no jump, labels, silence, refusals."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from far_app.attempt import FADE_IN
from far_app.detectors import PersonJudge
from far_app.device_input import DeviceInput
from far_app.motion import ActionScale
from far_app.protocols import Hold
from far_app.recording.attempt_reader import read_attempt
from far_app.recording.reader import read_session
from far_app.recording.schema import SessionInfo
from far_app.recording.writer import SessionWriter
from far_app.session_states import Intent, State
from far_app.take_over import PACE, PAGE_SILENT, Move, Nudge
from tests.session.kinematic import Forward, KinematicRobot
from tests.session.test_session import Desk

STEP = ActionScale().translation


class Seated(Desk):
    """A desk with somebody at the page, until `leave`."""

    def __init__(self, **settings) -> None:
        super().__init__(**({"headless": False} | settings))
        self._left = threading.Event()

        def be_there():
            while not self._left.wait(0.05):
                self.inbox.looked_at = time.monotonic()

        threading.Thread(target=be_there, daemon=True).start()

    def leave(self) -> None:
        self._left.set()
        time.sleep(0.1)
        self.inbox.looked_at = time.monotonic() - PAGE_SILENT - 1.0

    def run(self, act):
        """The session, with `act` in a thread once the attempt is under way; its errors are ours."""
        failures: list[BaseException] = []

        def acting():
            try:
                act()
            except BaseException as error:
                failures.append(error)
                self.inbox.put(Intent.QUIT)

        self.when(self.moving, acting)
        results = self.session.run()
        self._left.set()
        if failures:
            raise failures[0]
        return results

    def reaches(self, state: State) -> None:
        deadline = time.monotonic() + 10
        while self.state is not state:
            assert time.monotonic() < deadline, f"{self.state} is not {state}"
            time.sleep(0.002)

    def later(self, targets: int) -> None:
        """Wait until so many more targets were sent."""
        wanted, deadline = len(self.robot.targets) + targets, time.monotonic() + 10
        while len(self.robot.targets) < wanted:
            assert time.monotonic() < deadline, "no more targets"
            time.sleep(0.002)

    def press(self, *moves: Move) -> None:
        for move in moves:
            self.inbox.say(Nudge(move=move))


def mark_success(desk: Seated) -> None:
    desk.inbox.put(Intent.MARK_SUCCESS)


def test_a_person_takes_over_moves_the_arm_and_hands_back_without_a_jump():
    desk = Seated(policy=Forward(speed=0.5), horizon=60, attempts=1, robot=KinematicRobot(goal=9.0))
    mine: dict[str, int] = {}

    def act():
        desk.inbox.put(Intent.TAKE_OVER)
        desk.reaches(State.TAKEN_OVER)
        desk.later(3)
        mine["first"] = len(desk.robot.targets)
        desk.later(10)
        desk.press(Move.UP, Move.UP, Move.CLOSE)
        desk.later(10)
        desk.inbox.put(Intent.HAND_BACK)
        desk.reaches(State.RUNNING)

    (result,) = desk.run(act)
    steps = desk.session.driver.attempts[0].steps
    theirs = np.array([s.intervention for s in steps])
    first, last = np.flatnonzero(theirs)[[0, -1]]
    assert theirs[first : last + 1].all(), "one stretch of ticks is labelled"
    assert sum(not s.intervention for s in steps) == 60, "the horizon counts the policy's ticks alone"
    shown = desk.session.board.telemetry(State.FINISHED, None)
    assert shown.tick == shown.horizon == len(steps), "and the page shows both"

    way = np.diff([t.pose.position for t in desk.robot.targets], axis=0)
    moved = np.linalg.norm(way, axis=1)
    assert moved.max() <= 0.5 * STEP + 1e-9, "nothing ever moves faster than the policy did"
    assert np.allclose(way[mine["first"] : mine["first"] + 8], 0.0), "the arm stands where the person took it"
    up = sum(s.sent[2] for s in steps[first : last + 1]) * STEP
    assert up == pytest.approx(0.010)
    assert max(abs(s.commanded[2]) for s in steps[first : last + 1]) <= PACE + 1e-9
    back = [abs(s.commanded[0]) for s in steps[last + 1 : last + 1 + FADE_IN]]
    assert back[0] <= 0.5 / FADE_IN + 1e-9 and np.diff(back[1:]).min() >= -1e-9
    assert steps[-1].commanded[0] == pytest.approx(0.5), "the policy has all of its motion again"
    assert not result.counted, "a trial with a person's help is in no figure"


def test_the_policy_does_not_see_chunks_from_before_the_person_moved_the_arm():
    desk = Seated(policy=Forward(speed=0.5), horizon=40, attempts=1, robot=KinematicRobot(goal=9.0))

    def act():
        desk.inbox.put(Intent.TAKE_OVER)
        desk.reaches(State.TAKEN_OVER)
        desk.later(20)
        desk.inbox.put(Intent.HAND_BACK)

    desk.run(act)
    steps = desk.session.driver.attempts[0].steps
    last = max(s.tick for s in steps if s.intervention)
    own = [s for s in steps if last < s.tick <= last + 3 and not s.starved]
    assert own and all(s.chunk_tick >= last - 3 for s in own)
    seen = np.isfinite([s.value for s in steps if s.intervention])
    assert np.count_nonzero(seen) > len(seen) / 4, "V is computed while a person has the arm, too"


def test_success_while_a_person_has_the_arm_is_a_recorded_demonstration(tmp_path):
    writer = SessionWriter(tmp_path, SessionInfo(task="lift", method="test"))
    desk = Seated(policy=Forward(speed=0.02), horizon=400, attempts=1, writer=writer, robot=KinematicRobot(goal=0.42))

    def act():
        desk.inbox.put(Intent.TAKE_OVER)
        desk.reaches(State.TAKEN_OVER)
        while desk.state is State.TAKEN_OVER:
            desk.press(Move.FORWARD)
            time.sleep(0.05)

    (result,) = desk.run(act)
    assert result.success and desk.state is State.FINISHED
    session = read_session(writer.folder)
    told = {e.event: e for e in session.log}
    assert told["taken_over"].detail["source"] == "page"
    (recorded,) = session.attempts()
    assert [s.intervention for s in recorded.steps] == [s.intervention for s in desk.session.driver.attempts[0].steps]
    assert any(s.intervention for s in read_attempt(session.files[0]).steps)


def test_a_page_that_falls_silent_means_hold_until_it_is_heard_again():
    desk = Seated(policy=Forward(speed=0.5), horizon=30, attempts=1, robot=KinematicRobot(goal=9.0))

    def act():
        desk.inbox.put(Intent.TAKE_OVER)
        desk.reaches(State.TAKEN_OVER)
        desk.later(3)
        desk.leave()
        deadline = time.monotonic() + 10
        while "silent" not in desk.session.board.reason:
            assert time.monotonic() < deadline
            time.sleep(0.005)
        held = len(desk.robot.targets)
        assert isinstance(desk.robot.requests[-1], Hold)
        moved = desk.robot.pose.position + np.array([0.0, 0.05, 0.0])
        desk.robot.pose = replace(desk.robot.pose, position=moved)
        time.sleep(0.2)
        assert len(desk.robot.targets) == held, "no target while it is silent"
        assert desk.session.board.steering.silent
        desk.press(Move.LEFT)
        desk.inbox.looked_at = time.monotonic()
        desk.later(2)
        assert np.linalg.norm(desk.robot.targets[held].pose.position - moved) <= STEP, "from where the arm is"
        desk.inbox.put(Intent.MARK_FAILURE)

    desk.run(act)


def test_what_does_not_apply_is_refused_with_a_reason():
    desk = Seated(policy=Forward(speed=0.5), horizon=30, attempts=1, robot=KinematicRobot(goal=9.0))

    def act():
        desk.press(Move.UP)
        desk.inbox.put(Intent.HAND_BACK)
        desk.later(3)
        assert any("nobody has taken over" in line.text for line in desk.session.board._log)
        assert Intent.TAKE_OVER in desk.session.standing.allowed()
        desk.inbox.put(Intent.PAUSE)
        desk.reaches(State.PAUSED)
        assert Intent.TAKE_OVER in desk.session.standing.allowed(), "a paused attempt can be taken over"
        desk.inbox.put(Intent.TAKE_OVER)
        desk.reaches(State.TAKEN_OVER)
        desk.inbox.put(Intent.PAUSE)
        desk.reaches(State.PAUSED)
        desk.inbox.put(Intent.RESUME)
        desk.reaches(State.RUNNING)

    desk.run(act)
    steps = desk.session.driver.attempts[0].steps
    assert all(abs(s.commanded[2]) == 0.0 for s in steps), "the refused press moved nothing"


@pytest.mark.parametrize("phase", ["homing", "between"])
def test_the_way_home_cannot_be_taken_over(phase):
    desk = Seated()
    desk.session.standing.state, desk.session.standing.phase = State.PAUSED, phase
    assert "only an attempt" in desk.session.standing.refusal(Intent.TAKE_OVER)
    assert Intent.TAKE_OVER not in desk.session.standing.allowed()


def test_a_session_that_lets_nobody_take_over_says_why():
    desk = Seated(no_take_over="a shadow run holds the arm")
    desk.session.standing.state, desk.session.standing.phase = State.RUNNING, "attempt"
    assert "shadow" in desk.session.standing.refusal(Intent.TAKE_OVER)


def test_stop_ends_a_taken_over_attempt_like_any_other():
    desk = Seated(policy=Forward(speed=0.5), horizon=60, attempts=1, robot=KinematicRobot(goal=9.0))

    def act():
        desk.inbox.put(Intent.TAKE_OVER)
        desk.reaches(State.TAKEN_OVER)
        desk.inbox.put(Intent.STOP)
        desk.reaches(State.STOPPED)
        assert desk.robot.status.reason.startswith("STOP")
        desk.inbox.put(Intent.RESUME)

    (result,) = desk.run(act)
    assert not result.success


def test_a_person_who_is_asked_for_a_word_may_take_the_arm_instead():
    desk = Seated(policy=Forward(speed=0.1), horizon=10, attempts=1, detector=PersonJudge(20.0),
                  robot=KinematicRobot(goal=9.0))  # fmt: skip

    def act():
        deadline = time.monotonic() + 10
        while "success or failure?" not in desk.session.board.reason:
            assert time.monotonic() < deadline
            time.sleep(0.002)
        desk.inbox.put(Intent.TAKE_OVER)
        desk.reaches(State.TAKEN_OVER)
        desk.press(Move.FORWARD)
        desk.later(5)
        mark_success(desk)

    (result,) = desk.run(act)
    assert (result.success, result.judged_by) == (True, "operator")
    steps = desk.session.driver.attempts[0].steps
    assert [s.intervention for s in steps[:10]] == [False] * 10 and all(s.intervention for s in steps[10:])


class WithDevice(KinematicRobot):
    """A robot whose hw server reads a device."""

    device = DeviceInput(name="SpaceMouse", motion=np.zeros(6), age=0.01)

    def observe(self):
        return replace(super().observe(), device=self.device)


def test_a_devices_button_takes_over_its_motion_moves_the_arm_and_its_silence_holds_it():
    robot = WithDevice(goal=9.0)
    desk = Desk(robot=robot, policy=Forward(speed=0.5), horizon=40, attempts=1, headless=False)
    seated = {}

    def act():
        robot.device = replace(robot.device, presses=1)
        desk.when(lambda: desk.state is State.TAKEN_OVER, push)

    def push():
        robot.device = replace(robot.device, motion=np.array([0, 0, 0.25, 0, 0, 0]))
        time.sleep(0.3)
        robot.device = replace(robot.device, age=1.0)
        desk.when(lambda: "SpaceMouse has been silent" in desk.session.board.reason, silent)

    def silent():
        seated["held"] = len(robot.targets)
        time.sleep(0.2)
        seated["still"] = len(robot.targets) == seated["held"]
        robot.device = replace(robot.device, age=0.01, motion=np.zeros(6))
        time.sleep(0.1)
        robot.device = replace(robot.device, presses=2)

    desk.when(desk.moving, act)
    desk.session.run()
    assert seated["still"]
    theirs = [s for s in desk.session.driver.attempts[0].steps if s.intervention]
    assert max(s.sent[2] for s in theirs) == pytest.approx(0.25), "up to what the device asked for"
