"""The attempt view's pure parts: what is flagged under a what-if, what a press does, what damage shows."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from far_app.errors import RecordingError
from far_app.marks import Judged, Mark, Verdict
from far_app.recording import corrections, marks
from far_app.recording.attempt_reader import read_attempt
from far_app.recording.reader import read_session
from far_app.types import Contrast, FlagCorrection
from far_app.what_if import RECORDED, Answer
from ui import why_html, why_marks
from ui.why_model import Case, Choice, attribution, beside, case_of, deepest, executed, path, q_colors
from ui.why_session import Sitting
from ui.why_state import VERDICTS, Looking, Press, mark_offers, moved, offers

SAMPLE = Path(__file__).resolve().parents[2] / "recordings/sample"
AS_RECORDED = Choice()


@pytest.fixture(scope="module")
def case() -> Case:
    return case_of(read_attempt(SAMPLE / "trial_0001/attempt_1.mcap"))


@pytest.fixture
def session(tmp_path: Path) -> Path:
    return Path(shutil.copytree(SAMPLE, tmp_path / "session"))


def test_as_recorded_it_shows_what_was_flagged_then(case: Case) -> None:
    found = attribution(case, AS_RECORDED)
    assert found.flagged == case.flagged and len(found.flagged) == 15
    assert found.rank(deepest(found)) == (1, 143)


def test_the_recorded_rho_flags_the_same_chunks_when_asked_as_a_what_if(case: Case) -> None:
    assert attribution(case, replace(AS_RECORDED, recorded=False)).flagged == case.flagged


def test_more_rho_flags_more_and_keeps_the_worse(case: Case) -> None:
    few, many = (set(attribution(case, Choice(rho=rho, recorded=False)).flagged) for rho in (5.0, 30.0))
    assert few < many


def test_another_horizon_changes_the_value_change(case: Case) -> None:
    found = attribution(case, Choice(horizon=16, recorded=False))
    assert len(found.changes) == case.length - 16
    assert found.changes[3] == pytest.approx(case.values[19] - case.values[3])


def test_another_critics_values_take_the_recorded_ones_place(case: Case) -> None:
    choice = Choice(critic="other", recorded=False)
    assert attribution(case, choice).flagged == ()
    answer = Answer(number=1, file="", critic="other", values=np.linspace(1.0, 0.0, case.length))
    assert np.allclose(attribution(case, choice, answer=answer).values, answer.values)


def test_the_operators_last_word_on_a_chunk_counts(case: Case) -> None:
    off = FlagCorrection(tick=50, flagged=False, by="ada")
    on = FlagCorrection(tick=90, flagged=True, by="ada")
    assert set(attribution(case, AS_RECORDED, (off, on)).flagged) == (set(case.flagged) - {50}) | {90}
    assert attribution(case, AS_RECORDED, (off, replace(off, flagged=True))).flagged == case.flagged
    nowhere = FlagCorrection(tick=149, flagged=True)
    assert attribution(case, AS_RECORDED, (nowhere,)).flagged == case.flagged


def test_stepping_goes_through_flagged_chunks_and_around() -> None:
    assert beside((3, 7, 20), 3, 1) == 7
    assert beside((3, 7, 20), 20, 1) == 3
    assert beside((3, 7, 20), 10, -1) == 7
    assert beside((), 10, 1) is None


def test_a_press_outside_its_limits_is_kept_inside(case: Case) -> None:
    found = attribution(case, AS_RECORDED)
    looking = Looking(tick=case.length - 1)
    assert moved(looking, Press.LATER, 0, case, found, ()).tick == case.length - 1
    assert moved(looking, Press.TICK, -5, case, found, ()).tick == 0
    assert moved(looking, Press.RHO, 1e9, case, found, ()).choice.rho == 100.0
    assert moved(looking, Press.CRITIC, 0, case, found, (RECORDED, "b")).choice.critic == "b"


def test_a_dead_control_says_why(case: Case) -> None:
    found = attribution(case, AS_RECORDED)
    offered = offers(
        Looking(tick=50), case, found, attempts=1, critics=(), can_correct="nobody keeps it", adapting=False
    )
    assert offered[Press.NEXT].enabled
    assert offered[Press.CORRECT].line == "nobody keeps it" and not offered[Press.CORRECT].enabled
    assert offered[Press.ADAPT].line == "only in far replay"
    assert all(offer.enabled or offer.line for offer in offered.values())


def test_a_chunks_path_begins_at_the_hand_and_adds_up_its_translations(case: Case) -> None:
    points = path(case, 20, executed(case, 20, 8), 0.008)
    start = case.observations[20].eef.position
    assert points.shape == (9, 3) and np.allclose(points[0], start)
    assert np.allclose(points[-1], start + 0.008 * sum(case.sent[t][:3] for t in range(20, 28)))
    assert len(path(case, 145, executed(case, 145, 8), 0.008)) == 6


def test_the_best_positive_is_the_greenest() -> None:
    colors = q_colors([3.0, 2.0, 1.0], negative=1.0)
    assert colors[0].tolist() == [0, 190, 90] and colors[2].tolist() == [235, 150, 0]


def test_numbers_name_drop_rank_q_and_distance(case: Case) -> None:
    contrast = Contrast(
        tick=50, negative_q=-17.0, positives=np.zeros((1, 8, 7), np.float32), q=np.array([-10.5]),
        distance=np.array([1.25]),
    )  # fmt: skip
    shown = replace(case, contrasts={50: contrast})
    text = why_html.numbers(shown, attribution(shown, AS_RECORDED), 50, "")
    assert "drop 1 of 143" in text and "-10.50" in text and "+6.50" in text and "1.25" in text


def test_foreign_text_is_escaped(case: Case) -> None:
    bad = "<script>alert(1)</script>"
    word = FlagCorrection(tick=50, flagged=True, by=bad)
    found = attribution(case, AS_RECORDED, (word,))
    assert bad not in why_html.numbers(case, found, 50, bad) + why_html.foot(bad, (bad,), bad, bad)


def test_an_attempt_that_was_cut_off_is_shown_and_says_so(session: Path) -> None:
    file = session / "trial_0001/attempt_1.mcap"
    raw = file.read_bytes()
    file.write_bytes(raw[: len(raw) // 2])
    (session / "trials.jsonl").write_bytes((session / "trials.jsonl").read_bytes()[:900])
    sitting = Sitting(session)
    case = sitting.case(0)
    assert isinstance(case, Case) and case.outcome == "cut off" and not case.attributed
    assert 10 < case.length < 150 and len(attribution(case, AS_RECORDED).flagged) > 0
    assert any("cut off" in p for p in case.problems)
    assert any("not closed" in p for p in sitting.problems)


def test_an_unreadable_attempt_gives_its_reason(session: Path) -> None:
    (session / "trial_0001/attempt_2.mcap").write_bytes(b"not MCAP at all")
    assert isinstance(Sitting(session).case(1), str)


def test_corrections_are_appended_beside_the_recording_and_read_again(session: Path) -> None:
    before = {p: p.read_bytes() for p in session.rglob("*") if p.is_file()}
    for flagged in (False, True):
        word = FlagCorrection(tick=50, flagged=flagged, by="ada", wall=corrections.now())
        corrections.append(session, corrections.Word(trial=1, attempt=1, correction=word))
    found, problems = corrections.corrections(read_session(session))
    assert [w.flagged for w in found[1, 1]] == [False, True] and found[1, 1][0].by == "ada" and not problems
    assert all(p.read_bytes() == raw for p, raw in before.items())


def test_a_correction_that_was_cut_off_spoils_no_later_one(session: Path) -> None:
    word = FlagCorrection(tick=50, flagged=False, by="ada")
    corrections.append(session, corrections.Word(trial=1, attempt=1, correction=word))
    file = session / corrections.CORRECTIONS_FILE
    file.write_bytes(file.read_bytes()[:-20])
    corrections.append(session, corrections.Word(trial=1, attempt=1, correction=replace(word, tick=49)))
    found, problems = corrections.corrections(read_session(session))
    assert [w.tick for w in found[1, 1]] == [49] and "damaged or cut off" in problems[0]


def test_a_session_that_cannot_be_written_says_what_to_do(tmp_path: Path) -> None:
    word = corrections.Word(trial=1, attempt=1, correction=FlagCorrection(tick=1, flagged=True))
    with pytest.raises(RecordingError, match="copy the session"):
        corrections.append(tmp_path / "missing", word)


def test_a_word_on_an_attempt_is_shown_beside_the_programs_judgment_and_decides_the_head(session: Path) -> None:
    sitting = Sitting(session)
    before, case = sitting.judgment(0), sitting.case(0)
    assert before is not None and isinstance(case, Case) and before.verdict is None and not sitting.marks(0)
    for verdict, note in ((Verdict.SUCCESS, ""), (Verdict.UNSURE, "it <b>tipped</b>")):
        marks.append(session, Mark(trial=1, attempt=1, verdict=verdict, note=note, by="ada"))
    assert sitting.refresh()
    judged, words = sitting.judgment(0), sitting.marks(0)
    assert judged is not None and (judged.success, judged.judged_by) == (False, "horizon")
    text = why_marks.panel((1, 1), judged, words)
    assert "program: failure (horizon)" in text and "person: unsure, by ada" in text
    assert text.index("ada: unsure") < text.index("ada: success") and "<b>tipped" not in text
    found = attribution(case, AS_RECORDED)
    assert 'data-outcome="UNSURE"' in why_html.head(case, found, 50, 0, 2, "", judged)
    assert 'data-outcome="FAILURE"' in why_html.head(case, found, 50, 0, 2, "", before)
    assert sitting.judgment(1) != judged and sitting.marks(1) == ()


def test_a_mark_that_cannot_be_kept_says_why() -> None:
    failed = Judged(trial=1, attempt=1, success=False, judged_by="horizon")
    free = mark_offers(failed, "", "")
    assert all(free[press].enabled for press in VERDICTS) and free[Press.KEEP_NOTE].line == "write one first"
    assert mark_offers(failed, "", "slipped")[Press.KEEP_NOTE].enabled
    said = mark_offers(replace(failed, verdict=Verdict.FAILURE), "", "")
    assert not said[Press.MARK_FAILURE].enabled and said[Press.MARK_SUCCESS].enabled
    assert {offer.line for offer in mark_offers(None, "", "x").values()} == {"it has not ended"}
    assert {offer.line for offer in mark_offers(failed, "nobody keeps it", "x").values()} == {"nobody keeps it"}
