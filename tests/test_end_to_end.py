"""The main job, whole and real: `far run` with the shipped checkpoint, in the twin, at 30 Hz, recorded."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from far_app.recording.inspect import find_session, inspect_session
from far_app.recording.reader import read_session
from far_app.recording.weights_file import weights_path

FAR = Path(sys.executable).parent / "far"


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_trial_fails_learns_and_retries_with_no_button_pressed(tmp_path):
    """Whatever becomes of an attempt, all of it is in the recording; each failure with a retry left is adapted from."""
    summary = tmp_path / "summary.json"
    done = subprocess.run(
        [str(FAR), "run", "--headless", "--trials", "2", "--max-attempts", "3", "--seed", "11",
         "--recordings", str(tmp_path), "--summary-json", str(summary)],
        capture_output=True, text=True, timeout=580, stdin=subprocess.DEVNULL, check=False,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told = json.loads(summary.read_text())
    assert len(told["trials"]) == 2 and told["ticks"] > 30

    session = find_session(tmp_path)
    report = inspect_session(session)
    assert report.sound and report.state == "closed"
    for trial, line in zip(report.trials, told["trials"], strict=True):
        assert (trial.scene_seed, len(trial.attempts), trial.success) == (
            line["seed"],
            line["attempts"],
            line["success"],
        )
        assert [a.outcome for a in trial.attempts[:-1]] == ["failure"] * (len(trial.attempts) - 1)
        assert trial.attempts[0].policy_version == "base"
        for attempt, retry in zip(trial.attempts[:-1], trial.attempts[1:], strict=True):
            assert attempt.adaptation in ("adapted", "stopped", "empty"), attempt
            assert attempt.flagged > 0
            if attempt.adaptation == "adapted":
                assert retry.policy_version != attempt.policy_version
                assert weights_path(session / attempt.file).exists(), "what it learnt is kept"
    for file in read_session(session).files:
        assert file.with_suffix(".rrd").exists(), "each attempt also becomes one .rrd"
