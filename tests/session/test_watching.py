"""A slow success detector never holds up a tick, and one that fails leaves the word to the operator."""

from __future__ import annotations

import threading
import time

import pytest

from far_app.protocols import SuccessDetector
from far_app.session.watching import WatchingDetector
from far_app.types import Judge, Outcome
from tests.session.kinematic import Forward, KinematicRobot
from tests.session.test_session import Desk

YES = Outcome(success=True, judged_by=Judge.DETECTOR)


class Slow:
    """Says yes at its third look; each takes a while."""

    def __init__(self, seconds: float = 0.02, breaks: bool = False, yes: int = 3) -> None:
        self.seconds, self.breaks, self.yes, self.looks, self.begun, self.patience = seconds, breaks, yes, 0, 0, 0.0

    def begin(self) -> None:
        self.looks, self.begun = 0, self.begun + 1

    def judge(self, observation):
        time.sleep(self.seconds)
        if self.breaks:
            raise ValueError("no such picture")
        self.looks += 1
        return YES if self.looks == self.yes else None


@pytest.fixture
def watching():
    made = []

    def make(detector: Slow, wait: float = 5.0) -> WatchingDetector:
        made.append(WatchingDetector(detector, wait))
        return made[-1]

    yield make
    for detector in made:
        detector.close()


def test_a_look_never_waits_and_the_word_comes_later(watching):
    detector = watching(Slow(seconds=0.05))
    assert isinstance(detector, SuccessDetector)
    detector.begin()
    newest = KinematicRobot().observe()
    began, said = time.monotonic(), None
    while said is None and time.monotonic() - began < 5:
        asked = time.monotonic()
        said = detector.judge(newest)
        assert time.monotonic() - asked < 0.02
        time.sleep(0.01)
    assert said == YES


def test_the_word_on_the_last_attempt_is_not_the_next_ones(watching):
    inner = Slow(seconds=0.1, yes=1)
    detector = watching(inner)
    detector.begin()
    newest = KinematicRobot().observe()
    detector.judge(newest)
    time.sleep(0.05)
    detector.begin()  # while it still looks at the attempt before
    time.sleep(0.15)
    assert detector.judge(newest) is None
    assert inner.looks <= 1


def test_one_that_fails_leaves_it_to_the_operator(watching, caplog):
    detector = watching(Slow(breaks=True), wait=5.0)
    detector.begin()
    newest = KinematicRobot().observe()
    detector.judge(newest)
    deadline = time.monotonic() + 5
    while detector.patience == 0.0:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert detector.patience == 5.0 and "no such picture" in caplog.text
    detector.begin()
    assert detector.patience == 0.0, "the next attempt gets another chance"


def test_a_session_ends_its_attempt_at_the_detectors_word(watching):
    desk = Desk(policy=Forward(speed=0.05), horizon=60, attempts=1, detector=watching(Slow()))
    (result,) = desk.session.run()
    assert (result.success, result.judged_by) == (True, "detector")
    assert len(desk.session.driver.attempts[0].steps) < 30
    assert threading.active_count() < 50
