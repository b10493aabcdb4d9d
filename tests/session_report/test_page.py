"""The page on recorded sessions: figures from the last word on each attempt, every failure with its flagged moment,
and nothing fetched from anywhere."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from far_app.cli import main
from far_app.config import AttributionConfig
from far_app.recording.attempt_reader import read_attempt
from far_app.recording.reader import read_session
from far_app.recording.schema import SessionInfo
from far_app.recording.writer import SessionWriter
from far_app.session_report.failures import blame
from far_app.session_report.outcomes import by_attempt, differences, groups, labels
from far_app.session_report.page import page
from far_app.types import Judge, Outcome
from tests.recording import sessions, values


def session(root: Path, method: str, solved_by: dict[int, int | None], attempts: int = 2) -> Path:
    """A session whose trials (by scene) are solved by that attempt, or never."""
    info = SessionInfo(task="lift", method=method, cameras=("front",), config={"task": {"max_attempts": attempts}})
    writer = SessionWriter(root, info, space_to_start=0, space_to_go_on=0)
    for trial, (scene, solved) in enumerate(solved_by.items(), start=1):
        writer.begin_trial(trial, scene)
        for attempt in range(1, (solved or attempts) + 1):
            writer.begin_attempt(attempt, "base")
            writer.end_attempt(values.attempt(attempt, 2, success=attempt == solved))
        writer.end_trial(success=solved is not None, attempts=solved or attempts)
    writer.close()
    return writer.folder


def test_success_by_attempt_and_paired_differences(tmp_path):
    far = session(tmp_path, "far", {1: 1, 2: 2, 3: 2, 4: None})
    naive = session(tmp_path, "nr", {1: 1, 2: None, 3: None, 9: 1})
    found = groups([read_session(far), read_session(naive)])
    assert labels(found) == ["far", "nr"] and [len(g.trials) for g in found] == [4, 4]
    assert [(r.solved, r.trials) for r in by_attempt(found[0])] == [(1, 4), (3, 4)]
    assert by_attempt(found[0])[1].interval == pytest.approx((0.30, 0.95), abs=0.01)
    between, gained, _ = differences(found)
    assert (between.left, between.right, between.scenes) == ("nr", "far", 3)
    assert (between.mean, between.only_left, between.only_right) == (pytest.approx(-2 / 3), 0, 2)
    assert (gained.right, gained.mean, gained.only_right) == ("far, first attempt", 0.5, 0)


def test_the_last_word_counts_and_a_trial_cut_short_is_in_no_figure(tmp_path):
    writer = SessionWriter(
        tmp_path, SessionInfo(task="lift", method="far", config={"task": {"max_attempts": 3}}),
        space_to_start=0, space_to_go_on=0,
    )  # fmt: skip
    for trial in (1, 2, 3, 4):
        writer.begin_trial(trial, trial)
        writer.begin_attempt(1, "base")
        if trial > 2:
            writer.event({3: "reduced_speed", 4: "taken_over"}[trial])
        writer.end_attempt(values.attempt(1, 1))
        if trial != 2:
            writer.mark(Outcome(success=True, judged_by=Judge.OPERATOR))
        writer.end_trial(success=trial != 2, attempts=1)
    writer.close()
    [group] = groups([read_session(writer.folder)])
    assert [t.solved_by for t in group.trials] == [1] and group.unfinished == 3


def test_the_page_is_whole_in_itself_and_shows_each_failures_flagged_moment(tmp_path, monkeypatch, capsys):
    folder = sessions.small_session(tmp_path, steps=14)
    monkeypatch.chdir(tmp_path)
    assert main(["report", str(folder)]) == 0
    out = tmp_path / f"report_{folder.name}.html"
    text = out.read_text()
    assert capsys.readouterr().out.strip() == out.name
    assert not re.findall(r'(?:src|href)="(?!data:)', text) and "http" not in text and "<script" not in text
    assert text.count("<article>") == 1 and "3 flagged chunks" in text and re.search("t = [345], before", text)
    assert text.count("data:image/jpeg") == 4, "two cameras at t and at t + H"
    assert "failure" in text and "24 pairs" in text and "Wilson" in text
    assert main(["report", str(folder)]) == 2 and "exists" in capsys.readouterr().err
    assert main(["report", str(folder), "--overwrite"]) == 0


def test_a_damaged_session_is_reported_as_far_as_it_goes(tmp_path):
    folder = sessions.small_session(tmp_path, steps=12)
    file = folder / "trial_0001/attempt_1.mcap"
    file.write_bytes(file.read_bytes()[:-400])
    (folder / "trial_0001/attempt_2.mcap").write_bytes(b"something else entirely")
    text = page([folder])
    assert "Missing or damaged" in text and "is not an MCAP file" in text


def test_without_a_lesson_the_blame_is_worked_out_from_the_recorded_values(tmp_path):
    folder = session(tmp_path, "nr", {1: None})
    recording = read_attempt(folder / "trial_0001/attempt_2.mcap")
    found = blame(recording, AttributionConfig())
    assert found.afterwards and found.worst is None, "two ticks hold no whole chunk"
    longer = sessions.small_session(tmp_path / "b", steps=14)
    found = blame(read_attempt(longer / "trial_0001/attempt_2.mcap"), AttributionConfig(rho=50))
    assert found.afterwards and found.worst is not None and np.isfinite(found.threshold)


def test_names_are_escaped(tmp_path):
    folder = sessions.small_session(tmp_path, steps=2)
    header = json.loads((folder / "session.json").read_text())
    header["info"]["policy"] = "<script>alert(1)</script>"
    (folder / "session.json").write_text(json.dumps(header))
    assert "<script" not in page([folder])


def test_folders_that_are_neither_are_refused(tmp_path, capsys):
    assert main(["report", str(tmp_path)]) == 2
    assert "holds no session" in capsys.readouterr().err
