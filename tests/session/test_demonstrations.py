"""Demonstrations in the real-time session: each is kept, discarded or recorded again, and nothing happens by itself."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from far_app.cli.demo_person import LEAD, begun
from far_app.detectors import PersonJudge
from far_app.protocols import Hold
from far_app.session_states import Intent, State
from far_app.take_over import Move, Nudge
from far_app.types import Attempt
from tests.session.kinematic import Forward, KinematicRobot
from tests.session.test_session import Desk


class Teacher:
    """A person who demonstrates in a thread: pushes the arm to its goal, then says the next of his words."""

    def __init__(self, *words: Intent, trials: int, goal: float = 0.42, **settings) -> None:
        self.kept: list[Attempt] = []
        self.desk = Desk(
            policy=Forward(speed=0.0), robot=KinematicRobot(goal=goal), trials=trials, headless=False, attempts=1,
            demonstrate="teleop", **settings,
        )  # fmt: skip
        self.desk.session.review._keep = self.kept.append
        self.seeds: list[int] = []
        self.words = list(words)
        self._ended = threading.Event()

    def run(self):
        thread = threading.Thread(target=self._teach, daemon=True)
        thread.start()
        try:
            return self.desk.session.run()
        finally:
            self._ended.set()
            thread.join(timeout=5)

    def _teach(self) -> None:
        desk = self.desk
        while not self._ended.wait(0.01):
            desk.inbox.looked_at = time.monotonic()
            if desk.state is State.TAKEN_OVER:
                desk.inbox.say(Nudge(move=Move.FORWARD))
            elif desk.state is State.REVIEWING and self.words:
                self.seeds.append(desk.session.board.scene_seed)
                self.say(self.words.pop(0))

    def say(self, word: Intent) -> None:
        self.desk.inbox.put(word)
        end = time.monotonic() + 5
        while self.desk.state is State.REVIEWING and time.monotonic() < end:
            time.sleep(0.005)


def test_kept_demonstrations_are_counted_and_one_that_is_recorded_again_is_of_the_same_scene():
    teacher = Teacher(Intent.KEEP, Intent.RECORD_AGAIN, Intent.DISCARD, Intent.KEEP, trials=2)
    teacher.run()
    assert teacher.seeds == [5, 6, 6, 7]
    assert [attempt.scene_seed for attempt in teacher.kept] == [5, 7]
    assert all(step.intervention for attempt in teacher.kept for step in attempt.steps)
    assert teacher.desk.state is State.FINISHED


def test_the_arm_is_held_and_nothing_goes_on_while_a_demonstration_is_reviewed():
    teacher = Teacher(trials=1)
    desk, seen = teacher.desk, {}

    def look():
        seen["targets"] = len(desk.robot.targets)
        time.sleep(0.3)
        seen["still"] = len(desk.robot.targets) == seen["targets"] and desk.state is State.REVIEWING
        seen["held"] = any(isinstance(r, Hold) and "reviewed" in r.reason for r in desk.robot.requests)
        teacher.words.append(Intent.KEEP)

    desk.when(lambda: desk.state is State.REVIEWING, look)
    teacher.run()
    assert seen["still"] and seen["held"] and len(teacher.kept) == 1


def test_what_is_no_success_cannot_be_kept_until_somebody_says_it_is_one():
    teacher = Teacher(trials=1, goal=9.0, detector=PersonJudge(0.0))
    desk, seen = teacher.desk, {}
    desk.when(lambda: desk.state is State.TAKEN_OVER and len(desk.robot.targets) > 5,
              lambda: desk.inbox.put(Intent.MARK_FAILURE))  # fmt: skip

    def review():
        desk.inbox.put(Intent.KEEP)
        time.sleep(0.2)
        seen["refused"] = desk.state is State.REVIEWING and Intent.KEEP not in desk.session.standing.allowed()
        teacher.words.append(Intent.DISCARD)
        desk.when(lambda: len(desk.session.board.history.attempts) == 2 and desk.state is State.REVIEWING, end)
        desk.when(lambda: desk.state is State.TAKEN_OVER, lambda: desk.inbox.put(Intent.MARK_SUCCESS))

    def end():
        teacher.words.append(Intent.KEEP)

    desk.when(lambda: desk.state is State.REVIEWING, review)
    teacher.run()
    assert seen["refused"] and [a.outcome.success for a in teacher.kept] == [True]


def test_there_is_no_policy_to_hand_back_to():
    teacher = Teacher(trials=1)
    desk = teacher.desk
    desk.session.standing.state = State.TAKEN_OVER
    assert "no policy" in desk.session.standing.refusal(Intent.HAND_BACK)


@pytest.mark.parametrize("idle", [0, 3, 30])
def test_the_time_before_the_first_motion_is_left_out_but_for_a_moment(idle):
    teacher = Teacher(Intent.KEEP, trials=1)
    teacher.run()
    (attempt,) = teacher.kept
    moving = tuple(s for s in attempt.steps if np.abs(s.sent[:6]).max() > 1e-3)
    still = tuple(replace(moving[0], sent=np.append(np.zeros(6), -1.0)) for _ in range(idle))
    trimmed = begun(replace(attempt, steps=still + moving))
    assert len(trimmed.steps) == min(idle, LEAD) + len(moving)
