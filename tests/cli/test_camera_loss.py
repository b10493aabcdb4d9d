"""A camera that goes while an attempt runs, whole: `far run` on the twin with a camera of the rig's own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from far_app.recording.inspect import find_session, inspect_session
from hw.rig import RIGS

FAR = [sys.executable, "-c", "import sys; from far_app.cli import main; sys.exit(main(sys.argv[1:]))"]
pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("trouble", "words"), [
    ("unplugged", "unplugged; plug it in"), ("frozen", "shows the same picture"),
])  # fmt: skip
def test_a_camera_lost_in_an_attempt_is_a_fault_in_words_and_the_recording_is_whole(
    trouble: str, words: str, tmp_path: Path
) -> None:
    rig = tmp_path / "rig.toml"
    camera = f'device = "synthetic:{trouble}@12+60"\nwidth = 1344\nheight = 376\neye = "left"\nlost_after = 0.6\n'
    rig.write_text((RIGS / "twin.toml").read_text() + f"\n[camera.front]\n{camera}")
    done = subprocess.run(
        [*FAR, "run", "--headless", "--policy", "test:wander", "--rig", str(rig), "--recordings", str(tmp_path),
         "--no-rerun", "--max-attempts", "9"],
        capture_output=True, text=True, timeout=120, stdin=subprocess.DEVNULL, check=False,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    last = done.stderr.strip().splitlines()[-1]
    assert "camera front is lost" in last and words in last, done.stderr
    report = inspect_session(find_session(tmp_path))
    assert report.sound and report.state == "closed"
    assert report.trials[-1].attempts[-1].judged_by in ("fault", ""), report.trials[-1]
