"""Success is held long enough; the operator's word stands above it. The contract of SuccessDetector."""

import numpy as np
import pytest

from far_app.detectors import OperatorOverride, PersonJudge, TwinCheck
from far_app.protocols import SuccessDetector
from far_app.types import Judge, Observation, Outcome, Pose, RobotMode, RobotStatus

POSE = Pose(position=np.zeros(3), quaternion=np.array([0.0, 0.0, 0.0, 1.0]))


def seen(success: bool | None) -> Observation:
    return Observation(
        seq=1, stamp=0.0, eef=POSE, gripper=1.0, joints=np.zeros(7), status=RobotStatus(mode=RobotMode.HOLD),
        success=success,
    )  # fmt: skip


@pytest.fixture(params=["twin", "override"])
def detector(request) -> SuccessDetector:
    return TwinCheck(5) if request.param == "twin" else OperatorOverride(TwinCheck(5))


def test_success_needs_five_consecutive_ticks(detector):
    assert isinstance(detector, SuccessDetector)
    detector.begin()
    ticks = [True] * 4 + [False] + [True] * 4
    assert [detector.judge(seen(s)) for s in ticks] == [None] * 9
    outcome = detector.judge(seen(True))
    assert outcome == Outcome(success=True, judged_by=Judge.TWIN)


def test_a_new_attempt_starts_counting_anew(detector):
    detector.begin()
    for _ in range(4):
        detector.judge(seen(True))
    detector.begin()
    assert detector.judge(seen(True)) is None


def test_without_a_check_nothing_is_decided(detector):
    detector.begin()
    assert [detector.judge(seen(None)) for _ in range(10)] == [None] * 10


def test_the_operators_first_word_stands_until_the_next_attempt():
    detector = OperatorOverride(TwinCheck(1))
    detector.begin()
    failure = Outcome(success=False, judged_by=Judge.OPERATOR)
    detector.rule(failure)
    detector.rule(Outcome(success=True, judged_by=Judge.OPERATOR))
    assert detector.judge(seen(True)) is failure
    detector.begin()
    assert detector.judge(seen(False)) is None


def test_a_person_is_waited_for_and_nobody_else_says_anything():
    detector = OperatorOverride(PersonJudge(20.0))
    assert isinstance(detector, SuccessDetector) and detector.patience == 20.0
    detector.begin()
    assert detector.judge(seen(True)) is None
    assert OperatorOverride(TwinCheck()).patience == 0.0
