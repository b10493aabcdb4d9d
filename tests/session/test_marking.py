"""People's words on attempts: kept with who and when, beside the program's judgment, in figures and in exports."""

from __future__ import annotations

import fcntl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from far_app.cli import main, replay_desk
from far_app.errors import RecordingError
from far_app.exchange.select import Selection, rollouts
from far_app.marks import NOTE_LIMIT, Mark, MarkAttempt, Verdict, trouble
from far_app.recording import marks
from far_app.recording.episodes import session_episodes
from far_app.recording.judged import judged
from far_app.recording.reader import read_session
from far_app.recording.schema import SessionInfo
from far_app.recording.writer import SessionWriter
from far_app.session.history import History
from far_app.session_report.outcomes import ended_trials
from far_app.session_states import Intent, State
from far_app.telemetry import TrialRow
from far_app.types import Attempt, Judge, Outcome
from tests.recording import sessions
from tests.session.kinematic import Forward, KinematicRobot
from tests.session.test_session import Desk
from ui.why_link import Link


def word(trial: int, attempt: int, verdict: Verdict | None = None, note: str = "") -> MarkAttempt:
    return MarkAttempt(session="test", mark=Mark(trial=trial, attempt=attempt, verdict=verdict, note=note, by="ada"))


def in_attempt(desk: Desk, trial: int, attempt: int):
    board = desk.session.board
    return lambda: (board.trial, board.attempt) == (trial, attempt) and desk.state is State.RUNNING


def test_a_failure_is_called_a_success_later_and_both_words_are_kept(tmp_path):
    writer = SessionWriter(tmp_path, SessionInfo(task="lift", method="test"))
    desk = Desk(policy=Forward(speed=0.1), horizon=8, attempts=1, trials=2, writer=writer, headless=False)
    desk.when(in_attempt(desk, 2, 1), lambda: desk.inbox.say(word(1, 1, Verdict.SUCCESS, "it was in the bin")))
    desk.session.run()
    (told,) = [judged for judged in desk.session.board.history.attempts if judged.trial == 1]
    assert (told.success, told.judged_by) == (False, "horizon"), "the program's own judgment stays"
    assert (told.verdict, told.by, told.final) == (Verdict.SUCCESS, "ada", True)
    row = desk.session.board.history.trials[0]
    assert row.success and "corrected" in row.judged_by and "ada" in row.note
    session = read_session(writer.folder)
    (kept,) = session.words
    assert kept.by == "ada" and kept.wall and kept.note == "it was in the bin"
    assert session.marks[1, 1].success and not session.marks[2, 1].success
    assert next(session.attempts()).outcomes[0].judged_by == "horizon"


def test_unsure_may_be_said_of_the_attempt_under_way_and_takes_its_trial_out_of_the_figures():
    desk = Desk(policy=Forward(speed=0.1), horizon=8, attempts=1, headless=False)
    desk.when(in_attempt(desk, 1, 1), lambda: desk.inbox.say(word(1, 1, Verdict.UNSURE)))
    desk.session.run()
    (row,) = desk.session.board.history.trials
    assert not row.counted and "unsure" in row.note


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        (word(1, 1, Verdict.SUCCESS), "under way"),
        (word(7, 1, Verdict.SUCCESS), "has not been made"),
        (word(1, 1), "neither a verdict nor a note"),
        (word(0, 1, Verdict.SUCCESS), "no attempt"),
        (replace(word(1, 1, Verdict.SUCCESS), session="another"), "another"),
        (word(1, 1, None, "x" * (NOTE_LIMIT + 1)), "shorten"),
    ],
)
def test_a_mark_that_cannot_be_kept_is_refused_with_a_reason(asked, why):
    desk = Desk(policy=Forward(speed=0.1), horizon=40, attempts=1, headless=False)
    desk.when(in_attempt(desk, 1, 1), lambda: (desk.inbox.say(asked), time.sleep(0.1), desk.inbox.put(Intent.QUIT)))
    desk.session.run()
    assert any(why in line.text for line in desk.session.board._log)
    assert not desk.session.board.history.attempts or desk.session.board.history.attempts[0].verdict is None


def test_afterwards_the_last_verdict_counts_a_note_changes_none_and_nothing_is_erased(tmp_path):
    path = sessions.small_session(tmp_path, steps=3)
    before = (path / "trials.jsonl").read_bytes()
    for verdict, note in [(Verdict.SUCCESS, ""), (Verdict.FAILURE, "slipped"), (None, "the light was off")]:
        marks.append(path, Mark(trial=1, attempt=1, verdict=verdict, note=note, by="bo"))
    session = read_session(path)
    assert [w.verdict for w in session.words] == [Verdict.SUCCESS, Verdict.FAILURE, None]
    assert not session.marks[1, 1].success and not session.unsure
    assert (path / "trials.jsonl").read_bytes() == before


def test_a_corrected_mark_decides_what_is_exported_learnt_from_and_reported(tmp_path):
    path = sessions.small_session(tmp_path, steps=3)
    said: list[str] = []

    def successes():
        return [r.provenance.attempt for r in rollouts([path], Selection(only="successes"), said.append)]

    assert successes() == [2] and len(ended_trials(read_session(path))) == 1
    marks.append(path, Mark(trial=1, attempt=1, verdict=Verdict.SUCCESS))
    assert successes() == [1, 2] and ended_trials(read_session(path))[0].solved_by == 1
    marks.append(path, Mark(trial=1, attempt=2, verdict=Verdict.UNSURE))
    assert successes() == [1] and any("unsure" in line for line in said)
    assert ended_trials(read_session(path)) == [], "an unsure trial is in no figure"
    assert len(session_episodes(path, "lift")) == 1


def test_a_damaged_line_is_told_and_the_others_are_read(tmp_path):
    path = sessions.small_session(tmp_path, steps=3)
    marks.append(path, Mark(trial=1, attempt=1, verdict=Verdict.SUCCESS))
    with (path / marks.MARKS_FILE).open("ab") as file:
        file.write(b'{"event": "attempt_marked", "det')
    marks.append(path, Mark(trial=1, attempt=2, verdict=Verdict.FAILURE))
    session = read_session(path)
    assert len(session.words) == 2 and any("marks.jsonl" in problem for problem in session.problems)


def test_far_mark_says_what_it_changed_and_refuses_what_is_not_there(tmp_path, capsys):
    path = sessions.small_session(tmp_path, steps=3)
    assert main(["mark", str(path), "1", "1", "unsure", "--note", "it tipped", "--by", "cy"]) == 0
    assert "failure → unsure by cy it tipped" in capsys.readouterr().out
    assert main(["mark", str(path), "4", "1", "success"]) == 2
    assert "no ended attempt" in capsys.readouterr().err
    with pytest.raises(RecordingError, match="neither"):
        marks.append(path, Mark(trial=1, attempt=1))
    assert trouble(Mark(trial=1, attempt=1, note="fine")) == ""


def test_the_history_is_told_anew_after_a_change_and_only_then():
    history = History()
    attempt = Attempt(
        index=1, scene_seed=3, steps=(), final=KinematicRobot().observe(),
        outcome=Outcome(success=False, judged_by=Judge.HORIZON), policy_version="base",
    )  # fmt: skip
    history.attempt_ended(1, attempt)
    history.trial_ended(
        TrialRow(trial=1, scene_seed=3, attempts=1, success=False, judged_by="horizon", flagged=0, seconds=1.0, note="")
    )
    assert not history.trials[0].success
    assert history.trials is history.trials and history.attempts is history.attempts, "the loop asks at every snapshot"
    history.marked(Mark(trial=1, attempt=1, verdict=Verdict.SUCCESS, by="ada"))
    assert history.trials[0].success and history.attempts[0].verdict is Verdict.SUCCESS
    history.attempt_ended(2, attempt)
    assert len(history.attempts) == 2


def test_what_the_page_of_far_replay_says_is_kept_as_far_mark_keeps_it(tmp_path):
    by_page, by_command = (sessions.small_session(tmp_path / name, steps=3) for name in ("page", "command"))
    name = read_session(by_page).header.session
    with answering(by_page) as (say, said):
        say(replace(word(1, 1, Verdict.SUCCESS, "in the bin"), session=name))
        assert eventually(lambda: read_session(by_page).words != ())
        say(replace(word(4, 1, Verdict.SUCCESS), session=name))
        assert eventually(lambda: "no ended attempt 1 of trial 4" in said())
        say(word(1, 2, Verdict.SUCCESS))
        assert eventually(lambda: "a word on session test" in said())
    assert main(["mark", str(by_command), "1", "1", "success", "--note", "in the bin", "--by", "ada"]) == 0
    (kept,), (as_typed,) = read_session(by_page).words, read_session(by_command).words
    assert replace(kept, wall="") == replace(as_typed, wall="") and kept.wall and kept.by == "ada"
    told = judged(read_session(by_page))[1, 1]
    assert (told.success, told.judged_by) == (False, "horizon"), "the program's own judgment stays"
    assert told.final is True and told.note == "in the bin"


def test_a_session_that_is_still_recorded_takes_no_word_but_from_its_own_page(tmp_path):
    path = sessions.small_session(tmp_path, steps=3)
    with (path / "trials.jsonl").open("ab") as log, answering(path) as (say, said):
        fcntl.flock(log, fcntl.LOCK_EX)  # as the recorder of a living session holds it
        say(replace(word(1, 1, Verdict.SUCCESS), session=read_session(path).header.session))
        assert eventually(lambda: "still being recorded" in said())
    assert read_session(path).words == ()


@contextmanager
def answering(path: Path) -> Iterator[tuple[Callable[[MarkAttempt], bool], Callable[[], str]]]:
    """`far replay`'s own desk at work, and the attempt view's end of its sockets: say a word, hear the answer."""
    ended = threading.Event()
    with TemporaryDirectory(prefix="far") as sockets:
        desk = replay_desk.Desk(Path(sockets), read_session(path), (), lambda name: pytest.fail("no question is asked"))
        thread = threading.Thread(target=desk.serve, args=(ended.is_set,))
        thread.start()
        link = Link(Path(sockets))

        def said() -> str:
            list(link.poll())
            return link.answerer.said if link.answerer is not None else ""

        try:
            assert eventually(lambda: said() == "" and link.answerer is not None)
            yield link.send, said
        finally:
            ended.set()
            thread.join()
            link.close()
            desk.close()


def eventually(condition: Callable[[], bool]) -> bool:
    end = time.monotonic() + 10
    while time.monotonic() < end and not condition():
        time.sleep(0.02)
    return condition()
