"""What the page says follows from telemetry alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from ui_stage import adapting, rows, running, stopped

from far_app.session_states import Intent, State
from far_app.telemetry import CameraHealth, LoopHealth, Telemetry
from far_app.types import RobotMode, RobotStatus
from ui import html
from ui.stop import StopResult
from ui.view_model import Freshness, Tone, adaptation, arm_word, banner, camera_note, control, loop_gauges, summary

FRESH = Freshness(app=0.05, hw=0.05)


@pytest.mark.parametrize("state", list(State))
def test_every_state_has_a_word_and_a_sentence(state: State) -> None:
    shown = banner(replace(running(), state=state), FRESH)
    assert shown.word and shown.detail


def test_a_retry_says_what_it_is() -> None:
    assert "First attempt" in banner(running(attempt=1), FRESH).detail
    assert "Retry 2" in banner(running(attempt=3), FRESH).detail


def test_adapting_tells_attempt_flags_and_way_home() -> None:
    shown = banner(adapting(), FRESH)
    assert (shown.word, shown.tone) == ("LEARNING", Tone.LEARN)
    assert "Attempt 2 failed" in shown.detail
    assert "15 chunks flagged" in shown.detail
    assert "63 %" in shown.detail


def test_the_app_s_reason_goes_before_our_sentence() -> None:
    assert banner(replace(stopped(), reason="collision at joint 3"), FRESH).detail == "collision at joint 3"


def test_a_silent_app_overrides_its_last_word() -> None:
    shown = banner(running(), Freshness(app=4.0, hw=0.1))
    assert (shown.word, shown.tone) == ("APP SILENT", Tone.BAD)


def test_a_silent_hw_server_is_said_without_hiding_the_state() -> None:
    shown = banner(running(), Freshness(app=0.1, hw=4.0))
    assert shown.word == "RUNNING"
    assert shown.tone is Tone.BAD
    assert "hw server is silent" in shown.detail


def test_a_trial_s_outcome_is_named() -> None:
    done = replace(running(), state=State.TRIAL_DONE)
    assert banner(replace(done, history=rows()[:2]), FRESH).word == "SUCCESS"
    assert banner(replace(done, history=rows()), FRESH).word == "NOT SOLVED"


@pytest.mark.parametrize("state", [State.HOMING, State.AWAITING_SCENE])
def test_before_the_next_trial_the_last_one_s_outcome_is_told(state: State) -> None:
    rows_ = rows()
    telemetry = replace(running(), state=state, history=rows_[:2])
    assert banner(telemetry, FRESH).detail.startswith("Trial 2 solved. ")
    assert banner(replace(telemetry, history=rows_), FRESH).detail.startswith("Trial 3 not solved. ")
    assert "solved" not in banner(replace(telemetry, history=()), FRESH).detail


@pytest.mark.parametrize("intent", list(Intent))
@pytest.mark.parametrize("state", list(State))
def test_a_disabled_button_says_why_and_an_allowed_one_is_enabled(intent: Intent, state: State) -> None:
    telemetry = replace(running(), state=state, allowed=())
    refused = control(intent, telemetry, FRESH)
    assert refused.enabled == (intent is Intent.STOP)
    assert refused.enabled or refused.reason
    assert control(intent, replace(telemetry, allowed=(intent,)), FRESH).enabled


@pytest.mark.parametrize("fresh", [Freshness(), Freshness(app=9.0, hw=0.1)])
def test_only_stop_is_left_when_the_app_is_silent(fresh: Freshness) -> None:
    assert [i for i in Intent if control(i, running(), fresh).enabled] == [Intent.STOP]


def test_the_adaptation_card_shows_both_errors_with_their_trend() -> None:
    card = adaptation(adapting())
    shown = dict(card.rows)
    assert shown["step"] == "6 of 10"
    assert card.fraction == pytest.approx(0.6)
    assert "▼" in shown["l⁺ good chunks"]
    assert "▲" in shown["l⁻ flagged chunks"]
    assert shown["pairs"] == "120"


def test_before_any_failure_the_card_is_blank() -> None:
    assert {value for _, value in adaptation(running()).rows} == {"–"}


@pytest.mark.parametrize(
    ("loop", "label"),
    [(LoopHealth(hz=24.0, ticks=9), "loop"), (LoopHealth(overruns=1), "overruns"), (LoopHealth(starved=1), "starved")],
)
def test_trouble_in_the_loop_stands_out(loop: LoopHealth, label: str) -> None:
    gauges = loop_gauges(replace(running(), loop=loop))
    assert {g.label for g in gauges if g.tone is not Tone.IDLE} == {label}


def test_the_engine_is_shown_and_a_refused_one_stands_out() -> None:
    def engine(**fields: Any) -> Any:
        return next((g for g in loop_gauges(replace(running(), **fields)) if g.label == "engine"), None)

    assert engine() is None
    assert (engine(engine="openvino").value, engine(engine="openvino").tone) == ("openvino", Tone.IDLE)
    refused = engine(engine="torch", engine_refused=("openvino: it differs", "arranged: no"))
    assert (refused.value, refused.tone) == ("torch (openvino, arranged refused)", Tone.WARN)


def test_the_arm_speaks_for_itself() -> None:
    assert arm_word(None) == ("arm unknown", Tone.WARN)
    assert arm_word(RobotStatus(mode=RobotMode.LATCHED)) == ("arm latched", Tone.BAD)
    assert all(arm_word(RobotStatus(mode=mode))[0] for mode in RobotMode)


def test_the_session_in_one_line() -> None:
    assert summary(rows()) == "2 of 3 solved · 1 at once · 1 after a retry"
    assert summary(()) == "no trial finished yet"


def test_the_head_draws_as_many_attempts_as_can_be_told_apart() -> None:
    pips = [
        html.head(banner(replace(running(), max_attempts=n), FRESH), ("", Tone.IDLE)).count("<i class=")
        for n in (5, html.PIPS, html.PIPS + 1, 1_000_000)
    ]
    assert pips == [5, html.PIPS, 0, 0]


def test_foreign_text_is_escaped_everywhere() -> None:
    evil = "<img src=x onerror=alert(1)>"
    telemetry: Telemetry = replace(
        running(), reason=evil, policy_version=evil, method=evil, task=evil, session=evil,
        history=(replace(rows()[0], note=evil, judged_by=evil),),
        log=(replace(running().log[0], text=evil, level=evil),),
    )  # fmt: skip
    pages = [
        html.head(banner(telemetry, FRESH), (evil, Tone.IDLE)),
        html.history(telemetry.history, evil),
        html.events(telemetry.log, 0.0),
        html.foot(loop_gauges(telemetry), evil, 'http://x/"><script>', telemetry.session),
        html.stop_note(StopResult(pressed=0, latched=True, latency_ms=3), True, evil),
        html.adaptation(adaptation(replace(telemetry, adaptation_status=evil))),
    ]
    assert all("<img" not in page and "<script" not in page for page in pages)


def test_the_stop_note_never_claims_an_unconfirmed_latch() -> None:
    assert "stopping" in html.stop_note(StopResult(pressed=0, latched=None), False, "")
    assert "NOT CONFIRMED" in html.stop_note(StopResult(pressed=0, latched=False), False, "")
    assert "latched in 12 ms" in html.stop_note(StopResult(pressed=0, latched=True, latency_ms=12.3), True, "STOP")
    assert "latched" not in html.stop_note(StopResult(pressed=0, latched=True, latency_ms=12.3), False, "")


def test_a_camera_that_is_well_and_one_that_is_drawn_say_nothing() -> None:
    assert camera_note(None) == camera_note(CameraHealth(frames=900, age=0.04)) == ("", Tone.IDLE)


def test_a_camera_says_what_went_wrong_so_far_and_warns_only_while_it_does() -> None:
    ill = CameraHealth(frames=900, dropped=12, frozen=40, reopened=2, age=0.02)
    assert camera_note(ill) == ("12 dropped · 40 frozen · back 2×", Tone.IDLE)
    assert camera_note(replace(ill, age=1.34)) == ("picture 1.3 s old · 12 dropped · 40 frozen · back 2×", Tone.WARN)
