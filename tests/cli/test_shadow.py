"""`far run --shadow` and the preflight, whole: the twin behind its hw server, the shipped policy."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from far_app.recording.inspect import find_session
from far_app.recording.reader import read_session
from hw.rig import RIGS

FAR = [sys.executable, "-c", "import sys; from far_app.cli import main; sys.exit(main(sys.argv[1:]))"]
pytestmark = pytest.mark.slow


def far(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*FAR, *words], capture_output=True, text=True, timeout=200, stdin=subprocess.DEVNULL, check=False,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip


def test_a_shadow_run_plans_records_and_never_moves_the_arm(tmp_path: Path) -> None:
    done = far("run", "--headless", "--shadow", "--trials", "1", "--recordings", str(tmp_path))
    assert done.returncode == 0, done.stderr
    (recording,) = read_session(find_session(tmp_path)).attempts()
    attempt = recording.attempt()
    assert len(attempt.steps) == 150 and all(np.isnan(s.sent).all() for s in attempt.steps)
    places = np.array([s.observation.eef.position for s in attempt.steps])
    assert np.ptp(places, axis=0).max() < 1e-4, "metres"
    assert np.abs([s.commanded[:3] for s in attempt.steps]).max() > 0.1, "the policy wanted to move"


def test_another_action_scale_and_another_camera_refuse_the_start_in_one_line(tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    camera = 'device = "synthetic"\nwidth = 1344\nheight = 376\neye = "left"\n'
    rig.write_text(
        (RIGS / "twin.toml").read_text().replace("translation = 0.008", "translation = 0.004")
        + f"\n[camera.front]\n{camera}[camera.wrist]\n{camera}"
    )
    done = far("run", "--headless", "--trials", "1", "--recordings", str(tmp_path / "r"), "--rig", str(rig))
    assert done.returncode == 2
    (line,) = done.stderr.strip().splitlines()
    assert "an action of 1 moved the hand by 8 mm, here by 4 mm" in line
    assert "camera 'front' was drawn by the twin; here it is frames of 1344×376, left eye" in line
    assert not (tmp_path / "r").exists()
