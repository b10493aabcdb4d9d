"""far inspect says what is there, and everything that is not."""

import json
import shutil
from pathlib import Path

import pytest

from far_app.errors import RecordingError
from far_app.recording.inspect import find_session, inspect_command, inspect_session

from . import sessions, values


def test_a_whole_session_is_sound(tmp_path: Path) -> None:
    folder = sessions.small_session(tmp_path)
    report = inspect_session(folder)
    assert report.sound and report.problems == () and report.state == "closed"
    [trial] = report.trials
    assert (trial.trial, trial.scene_seed, trial.success, trial.judged_by, trial.ended) == (1, 7, True, "twin", True)
    first, second = trial.attempts
    assert (first.outcome, first.judged_by, first.steps, first.flagged, first.pairs) == (
        "failure",
        "horizon",
        12,
        3,
        24,
    )
    assert (second.outcome, second.judged_by, second.policy_version) == ("success", "twin", "base+1")
    assert first.duration_s == pytest.approx(0.4) and first.frames == {"front": 13, "wrist": 13}


def test_the_json_and_the_table_say_the_same(tmp_path: Path) -> None:
    folder = sessions.small_session(tmp_path)
    text, status = inspect_command(folder, as_json=True)
    body = json.loads(text)
    assert status == 0 and body["sound"] is True
    assert [attempt["steps"] for attempt in body["trials"][0]["attempts"]] == [12, 12]
    table, status = inspect_command(folder, as_json=False)
    assert status == 0
    for word in (folder.name, "lift", "far", "horizon", "twin", "success", "failure", "adapted", "nothing is missing"):
        assert word in table


def test_a_session_being_recorded_is_not_called_cut_off(tmp_path: Path) -> None:
    writer = sessions.open_writer(tmp_path)
    writer.begin_trial(1, 7)
    assert inspect_session(writer.folder).state == "recording"
    writer.close()
    assert inspect_session(writer.folder).state == "closed"


def test_missing_and_unknown_files_are_named(tmp_path: Path) -> None:
    folder = sessions.small_session(tmp_path)
    (folder / "trial_0001/attempt_2.mcap").rename(folder / "trial_0001/attempt_9.mcap")
    problems = inspect_session(folder).problems
    assert "trial_0001/attempt_2.mcap is missing" in problems
    assert "trial_0001/attempt_9.mcap: trials.jsonl does not know of it" in problems


def test_steps_lost_behind_a_sound_footer_are_noticed(tmp_path: Path) -> None:
    folder = sessions.small_session(tmp_path / "a", steps=12)
    other = sessions.small_session(tmp_path / "b", steps=5)
    shutil.copy(other / "trial_0001/attempt_1.mcap", folder / "trial_0001/attempt_1.mcap")
    assert "trial_0001/attempt_1.mcap: 5 of 12 steps are readable" in inspect_session(folder).problems


def test_a_file_that_is_no_recording_is_named_and_the_rest_still_read(tmp_path: Path) -> None:
    folder = sessions.small_session(tmp_path)
    (folder / "trial_0001/attempt_1.mcap").write_bytes(b"something else entirely")
    report = inspect_session(folder)
    assert any("attempt_1.mcap" in problem and "is not an MCAP file" in problem for problem in report.problems)
    assert [attempt.attempt for attempt in report.trials[0].attempts] == [2]


def test_an_abandoned_attempt_is_no_damage(tmp_path: Path) -> None:
    writer = sessions.open_writer(tmp_path)
    writer.begin_trial(1, 7)
    writer.begin_attempt(1, "base")
    writer.add_step(values.step(0))
    writer.close("quit by the operator")
    report = inspect_session(writer.folder)
    assert report.sound
    [attempt] = report.trials[0].attempts
    assert (attempt.outcome, attempt.note, attempt.steps) == ("abandoned", "quit by the operator", 1)


def test_a_path_within_a_session_or_above_one_finds_it(tmp_path: Path) -> None:
    folder = sessions.small_session(tmp_path, steps=2)
    assert (
        find_session(folder) == find_session(folder / "trial_0001/attempt_1.mcap") == find_session(tmp_path) == folder
    )


def test_a_path_without_a_session_is_refused_with_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="holds no session; give a session's folder"):
        find_session(tmp_path)
    with pytest.raises(RecordingError, match="does not exist"):
        find_session(tmp_path / "nowhere")


def test_above_several_sessions_the_newest_is_found(tmp_path: Path) -> None:
    old = sessions.small_session(tmp_path, steps=1).rename(tmp_path / "sample")
    header = json.loads((old / "session.json").read_text(encoding="utf-8"))
    header["started"] = "2020-01-01T00:00:00+00:00"
    (old / "session.json").write_text(json.dumps(header), encoding="utf-8")
    assert find_session(tmp_path) == old
    new = sessions.small_session(tmp_path, steps=1)
    assert find_session(tmp_path) == new
