"""Which attempts are exported, from which tick on, and what is said of the others."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any, cast

import pyarrow.parquet as pq
import pytest

from far_app.cli import main
from far_app.errors import ConfigError
from far_app.exchange.rrd import from_tick, write_rrds
from far_app.exchange.select import Selection, chosen, rollouts, start_of, wanted
from far_app.recording.attempt_reader import read_attempt
from far_app.types import Judge, Outcome
from tests.recording import sessions, values

SUCCESS = Outcome(success=True, judged_by=Judge.OPERATOR)


def quiet(line: str) -> None:
    raise AssertionError(line)


def helped(first: int | None, previous: str = "") -> Any:
    steps = [SimpleNamespace(tick=t, intervention=first is not None and t >= first) for t in range(9)]
    return cast(Any, SimpleNamespace(steps=steps, header=SimpleNamespace(previous=previous)))


def test_filters(tmp_path):
    session = sessions.small_session(tmp_path, steps=3)
    ids = {only: [r.provenance.attempt for r in rollouts([session], Selection(only=only), quiet)]
           for only in ("all", "successes", "recoveries", "human")}  # fmt: skip
    assert ids == {"all": [1, 2], "successes": [2], "recoveries": [2], "human": []}


def test_a_persons_help_makes_a_recovery_of_a_success_and_its_first_step_is_where_it_begins():
    assert wanted(helped(4), SUCCESS, "human") and wanted(helped(4), SUCCESS, "recoveries")
    assert not wanted(helped(None), SUCCESS, "human") and not wanted(helped(None), SUCCESS, "recoveries")
    assert start_of(helped(4), "recovery") == start_of(helped(4, "trial_0001/attempt_1.mcap"), "recovery") == 4
    assert start_of(helped(None, "trial_0001/attempt_1.mcap"), "recovery") == 0
    assert start_of(helped(None), "recovery") is None and start_of(helped(None), "attempt") == 0


def test_recovery_segments_leave_out_first_attempts(tmp_path):
    session = sessions.small_session(tmp_path, steps=3)
    [only] = rollouts([session], Selection(segment="recovery"), quiet)
    assert (only.provenance.attempt, only.provenance.segment, len(only)) == (2, "recovery", 3)


def test_the_last_word_counts(tmp_path):
    writer = sessions.open_writer(tmp_path)
    writer.begin_trial(1, 7)
    writer.begin_attempt(1, "base")
    writer.end_attempt(values.attempt(1, 3))
    writer.mark(Outcome(success=True, judged_by=Judge.OPERATOR, note="it was in"))
    writer.end_trial(success=True, attempts=1)
    writer.close()
    [one] = rollouts([writer.folder], Selection(only="successes"), quiet)
    assert (one.provenance.judged_by, one.provenance.note) == ("operator", "it was in")
    assert one.episode.successes.tolist() == [False, False, False, True]


def test_a_damaged_attempt_is_left_out_with_a_word_and_the_rest_exported(tmp_path, capsys):
    session = sessions.small_session(tmp_path, steps=12)
    file = session / "trial_0001/attempt_1.mcap"
    file.write_bytes(file.read_bytes()[:3000])
    out = tmp_path / "dataset"
    assert main(["export", str(session), "--to", "lerobot", "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert "trial_0001/attempt_1.mcap is left out" in said.err and "1 episodes" in said.out
    [row] = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert row["far/attempt"] == 2


def refused(words: list[str], capsys: pytest.CaptureFixture[str], *expected: str) -> None:
    assert main(words) == 2
    (line,) = [x for x in capsys.readouterr().err.strip().splitlines() if x]
    assert line.startswith("far: ") and all(e in line for e in expected), line


@pytest.mark.parametrize("to", ["lerobot", "robomimic", "rrd"])
def test_a_target_that_exists_is_kept_unless_told_otherwise(to, tmp_path, capsys):
    session, out = sessions.small_session(tmp_path / "r", steps=2), tmp_path / "out"
    out.write_text("mine")
    words = ["export", str(session), "--to", to, "--out", str(out)]
    refused(words, capsys, str(out), "exists", "--overwrite")
    assert out.read_text() == "mine"
    refused([*words, "--overwrite", "--only", "human"], capsys, "no attempt to export")
    assert out.read_text() == "mine" and list(tmp_path.glob(".*")) == []
    assert main([*words, "--overwrite"]) == 0
    assert out.is_dir() or out.stat().st_size > 1000
    assert list(tmp_path.glob(".*")) == []


def test_a_recording_is_never_a_target(tmp_path, capsys):
    session = sessions.small_session(tmp_path, steps=2)
    words = ["export", str(session), "--to", "lerobot", "--overwrite", "--out"]
    refused([*words, str(session)], capsys, "a recording is never changed")
    refused([*words, str(session / "trial_0001")], capsys, "a recording is never changed")


def test_another_schema_and_mixed_sessions_are_refused_by_name(tmp_path, capsys):
    one, other = (sessions.small_session(tmp_path / name, steps=2) for name in "ab")
    header = json.loads((other / "session.json").read_text())
    header["info"]["task"] = "stack"
    (other / "session.json").write_text(json.dumps(header))
    words = ["export", str(one), str(other), "--to", "robomimic", "--out", str(tmp_path / "x")]
    refused(words, capsys, str(other), "'stack'", "'lift'", "export them apart")
    (other / "session.json").write_text(json.dumps({**header, "schema_version": 0}))
    refused(words, capsys, str(other), "schema version 0")


def test_rrd_draws_each_chosen_attempt_from_its_first_tick(tmp_path):
    session, drawn = sessions.small_session(tmp_path, steps=4), []

    def draw(recording, path):
        drawn.append((path.name, len(recording.steps)))
        path.write_bytes(b"rrd")

    count = write_rrds(tmp_path / "out", chosen([session], Selection(only="successes"), quiet), draw, False)
    assert count == 1 and drawn == [(f"{session.name}_trial_0001_attempt_2.rrd", 4)]
    with pytest.raises(ConfigError, match="no attempt to export"):
        write_rrds(tmp_path / "none", chosen([session], Selection(only="human"), quiet), draw, False)


def test_a_segments_blame_stays_with_its_steps(tmp_path):
    recording = read_attempt(sessions.small_session(tmp_path, steps=12) / "trial_0001/attempt_1.mcap")
    later = from_tick(recording, 4)
    assert later.adaptation is not None and recording.adaptation is not None
    assert later.steps[0].tick == 4 and later.adaptation.flagged == (0, 1)
    assert later.adaptation.value_changes[0] == recording.adaptation.value_changes[4]
    assert from_tick(recording, 0) is recording
