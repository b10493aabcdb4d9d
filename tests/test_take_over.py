"""A person's hand as actions: steps, continuous motion, gripper, silence."""

import numpy as np
import pytest

from far_app.device_input import DeviceInput
from far_app.motion import ActionScale
from far_app.take_over import DEVICE_SILENT, PACE, PAGE_SILENT, STEP, TURN, WAITING, Hand, Move, Source

SCALE = ActionScale()
UNIT = np.array([SCALE.translation] * 3 + [SCALE.rotation] * 3)


def hand(gripper: float = -1.0) -> Hand:
    taken = Hand(SCALE)
    taken.take(gripper, Source.PAGE)
    return taken


def device(motion=(0.0,) * 6, **changes) -> DeviceInput:
    return DeviceInput(**({"name": "SpaceMouse", "motion": np.array(motion), "age": 0.01} | changes))


def carried_out(taken: Hand, ticks: int = 40) -> np.ndarray:
    """Metres and radians over so many ticks."""
    return sum((taken.action(None)[:6] * UNIT for _ in range(ticks)), np.zeros(6))


@pytest.mark.parametrize("move", [m for m in Move if m not in (Move.OPEN, Move.CLOSE)])
def test_a_press_moves_one_axis_by_one_step_at_a_gentle_pace_and_then_the_arm_stands(move):
    taken = hand()
    assert taken.nudge(move) == ""
    way = np.zeros(6)
    actions = [taken.action(None) for _ in range(20)]
    assert max(np.abs(a[:6]).max() for a in actions) <= PACE + 1e-9
    way = sum(a[:6] * UNIT for a in actions)
    assert sorted(np.abs(way))[:5] == [0.0] * 5
    assert np.abs(way).max() == pytest.approx(STEP if np.argmax(np.abs(way)) < 3 else TURN)
    assert not actions[-1][:6].any()


def test_opposite_moves_cancel_and_every_pair_is_opposite():
    for one, other in [
        (Move.FORWARD, Move.BACK), (Move.LEFT, Move.RIGHT), (Move.UP, Move.DOWN), (Move.ROLL_PLUS, Move.ROLL_MINUS),
        (Move.PITCH_PLUS, Move.PITCH_MINUS), (Move.YAW_PLUS, Move.YAW_MINUS),
    ]:  # fmt: skip
        taken = hand()
        assert taken.nudge(one) == "" and taken.nudge(other) == ""
        assert np.abs(carried_out(taken)).max() < 1e-12


def test_presses_faster_than_the_arm_are_refused_not_saved_up():
    taken = hand()
    answers = [taken.nudge(Move.UP) for _ in range(WAITING + 2)]
    assert answers[:WAITING] == [""] * WAITING and all("still being carried out" in a for a in answers[WAITING:])
    assert carried_out(taken)[2] == pytest.approx(WAITING * STEP)


def test_the_gripper_stays_as_it_was_until_it_is_asked_for():
    taken = hand(gripper=1.0)
    assert taken.action(None)[6] == 1.0
    taken.nudge(Move.OPEN)
    assert taken.action(None)[6] == -1.0
    assert taken.action(device(gripper=1.0))[6] == 1.0
    assert taken.action(device())[6] == 1.0, "a gripper button that is let go changes nothing"


def test_without_a_person_there_is_no_action_and_presses_are_refused():
    free = Hand(SCALE)
    assert free.action(device(motion=(1.0,) * 6)) is None
    assert "take over first" in free.nudge(Move.UP)
    taken = hand()
    taken.let_go()
    assert taken.action(None) is None


def test_a_device_comes_before_waiting_steps_and_never_asks_for_more_than_one():
    taken = hand()
    taken.nudge(Move.UP)
    action = taken.action(device(motion=(3.0, 0, 0, 0, 0, 0)))
    assert action[0] == 1.0 and action[2] == 0.0 and taken.source is Source.DEVICE
    assert not taken.action(device())[:6].any(), "the steps that waited are forgotten"


@pytest.mark.parametrize("changes", [{"age": DEVICE_SILENT}, {"trouble": "unplugged"}])
def test_a_device_that_is_silent_moves_nothing_and_is_told(changes):
    taken = hand()
    taken.action(device(motion=(0.5,) * 6))
    gone = device(motion=(0.5,) * 6, **changes)
    assert not taken.action(gone)[:6].any()
    assert "SpaceMouse" in taken.silence(gone, 0.0)
    assert taken.silence(None, 0.0) == "the input device is gone"
    assert taken.silence(device(), 99.0) == "", "the page matters only where its steps have the arm"


def test_a_silent_page_is_told_only_while_its_steps_have_the_arm():
    assert "page" in hand().silence(None, PAGE_SILENT + 0.1)
    assert hand().silence(None, PAGE_SILENT - 0.1) == ""
    assert Hand(SCALE).silence(None, 99.0) == ""
