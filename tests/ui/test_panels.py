"""The panels' words and guards without a browser: what each button asks, and why it cannot act."""

from __future__ import annotations

from dataclasses import replace

import pytest
from ui_stage import running

from far_app.lineage import PolicyRow, Versions, VersionWish, Wish
from far_app.marks import Judged, Mark, MarkAttempt, Verdict
from far_app.session_states import Intent, State, allowed
from far_app.take_over import Move, Nudge, Steering
from ui.demonstration import Demonstration
from ui.keys import Page, key_of
from ui.lineage import Lineage
from ui.marks import Marks
from ui.panels import withheld
from ui.take_over import TakeOver, said
from ui.view_model import Freshness, banner, control

ROWS = (
    PolicyRow(name="base", parent=""), PolicyRow(name="1:base+a1", parent="base", trial=1, attempt=1, pairs=9),
    PolicyRow(name="3:base+a1", parent="1:base+a1", trial=3, attempt=1),
)  # fmt: skip
ATTEMPTS = (
    Judged(trial=1, attempt=1, success=False, judged_by="horizon"),
    Judged(trial=2, attempt=1, success=True, judged_by="twin"),
)
TAKEN = replace(running(), state=State.TAKEN_OVER, allowed=allowed(State.TAKEN_OVER), attempts=ATTEMPTS)


def item(panel, label):
    return next(item for item in panel.items if item.label == label)


def test_every_move_has_a_button_and_a_key_and_asks_for_just_that():
    panel = TakeOver()
    assert {i.asks(TAKEN).move for i in panel.items} == set(Move)
    for i in panel.items:
        assert i.reason(TAKEN) == "" and i.reason(running()) == "take over first"
        assert isinstance(i.asks(TAKEN), Nudge) and key_of(Page.CONSOLE, i.action) is not None


def test_who_has_the_arm_is_said_and_a_silent_source_in_red():
    assert said(running())[1].startswith("The policy has the arm")
    by_device = replace(TAKEN, steering=Steering(source="device", device="SpaceMouse", ticks=3))
    assert "SpaceMouse" in said(by_device)[1]
    silent = replace(TAKEN, steering=Steering(source="page", silent="the page is silent"))
    assert said(silent) == ("bad", "The arm is held: the page is silent.")
    assert "shadow" in said(replace(running(), steering=Steering(unavailable="a shadow run")))[1]


def test_take_over_and_hand_back_are_offered_where_they_apply_and_say_why_elsewhere():
    fresh = Freshness(app=0.0, hw=0.0)
    here = replace(running(), allowed=allowed(State.RUNNING))
    assert control(Intent.TAKE_OVER, here, fresh).enabled and not control(Intent.HAND_BACK, here, fresh).enabled
    assert control(Intent.HAND_BACK, TAKEN, fresh).enabled
    home = replace(running(), state=State.HOMING, allowed=allowed(State.HOMING))
    assert control(Intent.TAKE_OVER, home, fresh).reason == "only during an attempt"
    none = replace(running(), allowed=(), steering=Steering(unavailable="a shadow run holds the arm"))
    assert "shadow" in control(Intent.TAKE_OVER, none, fresh).reason
    assert banner(TAKEN, fresh).word == "TAKEN OVER"


def test_marks_begin_with_the_attempt_under_way_and_go_back_through_the_history():
    panel = Marks()
    assert "under way" in panel.html(TAKEN)
    assert item(panel, "Success").reason(TAKEN) == "it is under way"
    unsure = item(panel, "Unsure").asks(TAKEN)
    assert unsure == MarkAttempt(
        session=TAKEN.session, mark=Mark(trial=TAKEN.trial, attempt=TAKEN.attempt, verdict=Verdict.UNSURE)
    )  # fmt: skip
    item(panel, "Earlier").asks(TAKEN)
    assert "Trial 2, attempt 1" in panel.html(TAKEN) and "success (twin)" in panel.html(TAKEN)
    assert item(panel, "Failure").asks(TAKEN).mark == Mark(trial=2, attempt=1, verdict=Verdict.FAILURE)
    item(panel, "Earlier").asks(TAKEN)
    assert item(panel, "Earlier").reason(TAKEN) == "this is the first"
    item(panel, "Later").asks(TAKEN)
    item(panel, "Later").asks(TAKEN)
    assert item(panel, "Later").reason(TAKEN) == "this is the newest"


def test_the_programs_judgment_and_the_persons_word_stand_beside_each_other_escaped():
    said_so = replace(ATTEMPTS[1], verdict=Verdict.FAILURE, note="<b>fell</b>", by="ada")
    idle = replace(running(), state=State.TRIAL_DONE, attempts=(ATTEMPTS[0], said_so))
    text = Marks().html(idle)
    assert "success (twin)" in text and "failure, by ada" in text and "&lt;b&gt;" in text
    assert item(Marks(), "Failure").reason(idle) == "you said so"
    assert Marks().html(replace(idle, attempts=())) == '<p class="far-line">No attempt yet.</p>'


def test_a_note_is_kept_once_it_is_written():
    panel = Marks()
    assert item(panel, "Keep note").reason(TAKEN) == "write one first"
    panel._write("  the light was off ")
    assert item(panel, "Keep note").asks(TAKEN).mark.note == "the light was off"
    assert item(panel, "Keep note").reason(TAKEN) == "write one first"


def test_versions_are_gone_through_and_each_wish_names_the_chosen_one():
    panel = Lineage()
    now = replace(TAKEN, versions=Versions(rows=ROWS, acting="3:base+a1", undo="1:base+a1"))
    assert "3:base+a1 ← 1:base+a1 ← base" in panel.html(now)
    assert item(panel, "Act with it next").reason(now) == "it acts already"
    item(panel, "Older").asks(now)
    assert item(panel, "Act with it next").asks(now) == VersionWish(wish=Wish.RESTORE, version="1:base+a1")
    assert item(panel, "Begin trials with it").asks(now) == VersionWish(wish=Wish.KEEP, version="1:base+a1")
    item(panel, "Older").asks(now)
    assert item(panel, "Older").reason(now) == "this is the oldest"
    assert item(panel, "Begin trials with it").reason(now) == "trials begin with it"
    assert item(panel, "Undo the adaptation").asks(now) == VersionWish(wish=Wish.UNDO)
    assert item(panel, "Undo the adaptation").reason(replace(now, versions=Versions(rows=ROWS))) != ""
    closed = replace(now, versions=Versions(unavailable="this method has no weights that change"))
    assert all("no weights" in i.reason(closed) for i in panel.items[2:])


@pytest.mark.parametrize("intent", [Intent.KEEP, Intent.DISCARD, Intent.RECORD_AGAIN])
def test_a_word_on_a_demonstration_applies_only_when_one_waits(intent):
    panel = Demonstration()
    (button,) = [i for i in panel.items if i.action == intent]
    assert button.reason(running()) == "no demonstration waits"
    waits = replace(running(), state=State.REVIEWING, reason="success, 4.8 s", allowed=allowed(State.REVIEWING))
    assert button.reason(waits) == "" and button.asks(waits) is intent and "4.8 s" in panel.html(waits)
    if intent is Intent.KEEP:
        assert "mark it" in button.reason(replace(waits, allowed=(Intent.DISCARD,)))


def test_nothing_can_be_asked_of_an_app_that_is_silent_or_over():
    assert withheld(None, Freshness()) and withheld(running(), Freshness(app=9.0))
    assert withheld(replace(running(), state=State.FINISHED), Freshness(app=0.0)) == "the session is over"
    assert withheld(running(), Freshness(app=0.0)) == ""
