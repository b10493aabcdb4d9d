"""`far trials` whole and real: an A/B plan on the twin, killed in the middle and gone on with; a real arm's scene built
again through the page, on the fake controller."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from far_app.cli import main
from far_app.recording.inspect import inspect_session
from far_app.recording.reader import read_session
from hw.fake_xarm.control import FakeXArm
from tests.hw.conftest import FAKE_PORT, loopback
from ui.raw_client import RawClient

ROOT = Path(__file__).parent.parent
FAR = [sys.executable, "-u", "-c", "import sys; from far_app.cli import main; sys.exit(main(sys.argv[1:]))"]
METHODS = """
[[method]]
name = "patient"
method = "nr"
policy = "test:still"
[[method]]
name = "restless"
method = "nr"
policy = "test:wander"
"""


def started(*words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*FAR, "trials", *words], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        stdin=subprocess.DEVNULL,
    )  # fmt: skip


def begun(recordings: Path) -> list[dict]:
    """What each trial of all sessions was, oldest first; a torn last line is left out."""
    lines = [line for f in sorted(recordings.glob("*/trials.jsonl")) for line in f.read_text().splitlines(True)]
    entries = [json.loads(line) for line in lines if line.endswith("\n")]
    return [e["detail"] for e in entries if e["event"] == "trial_started"]


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_blinded_plan_on_the_twin_goes_on_after_sigkill_and_is_unblinded_at_its_end(tmp_path: Path, capsys):
    plan, recordings = tmp_path / "ab.toml", tmp_path / "r"
    plan.write_text('task = "lift"\nseeds = [3, 4]\nblind = true\nmax_attempts = 1\n' + METHODS)
    words = (str(plan), "--headless", "--recordings", str(recordings))
    first = started(*words)
    deadline = time.monotonic() + 120
    while len(begun(recordings)) < 2:
        assert time.monotonic() < deadline and first.poll() is None, first.stderr and first.stderr.read()
        time.sleep(0.1)
    time.sleep(1.0)  # into the second trial
    first.kill()
    told = first.communicate()[0]
    assert "1 of 4 trials done" in told and "A − B: no scene done under both yet" in told
    assert not any(name in told for name in ("patient", "restless", "test:"))
    cut = begun(recordings)[1]

    assert main(["trials", *words[:1], "--show", "--recordings", str(recordings)]) == 0
    assert "plan ab: 1 of 4 trials done" in capsys.readouterr().out, "nothing of what was done is lost"
    second = started(*words)
    told, err = second.communicate(timeout=200)
    assert second.returncode == 0, err
    assert "4 of 4 trials done" in told and "The plan is done" in told
    assert {line.strip() for line in told.splitlines() if " is " in line and line.startswith("  ")} in (
        {"A is patient", "B is restless"}, {"A is restless", "B is patient"},
    )  # fmt: skip
    ran = begun(recordings)
    assert ran[2] == cut, "the trial that was cut short comes first"
    assert len({(d["method"], d["scene"]) for d in ran}) == 4 and len(ran) == 5

    sessions = sorted(recordings.iterdir())
    assert inspect_session(sessions[1]).sound
    page = tmp_path / "page.html"
    assert main(["report", *map(str, sessions), "--out", str(page)]) == 0
    text = page.read_text()
    assert "4 of 4 trials done, 1 begun and left out" in text and "restless" in text and "A was" in text
    assert main(["report", str(sessions[0]), "--out", str(tmp_path / "half.html")]) == 0
    half = (tmp_path / "half.html").read_text()
    assert "blinded" in half and not any(f"{name}</td>" in half for name in ("patient", "restless"))
    changed = plan.read_text().replace('"test:still"', '"test:nan"')
    plan.write_text(changed)
    assert main(["trials", *words]) == 2
    assert "holds trials of another plan (other: methods)" in capsys.readouterr().err


@pytest.fixture
def fake() -> Iterator[FakeXArm]:
    fake = FakeXArm.start(loopback(), FAKE_PORT)
    yield fake
    fake.close()


def scene(x: int, noise: int) -> np.ndarray:
    picture = np.full((240, 240, 3), 120, np.uint8)
    picture[:80] = 190
    picture[140:170, x : x + 30] = (40, 40, 210)
    return (picture + np.random.default_rng(noise).normal(0, 3, picture.shape)).clip(0, 255).astype(np.uint8)


def cell(folder: Path) -> Path:
    """The shipped rig with a camera that plays a video of the cube on the right."""
    film = cv2.VideoWriter(str(folder / "cube.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30, (240, 240))
    for frame in range(30):
        film.write(scene(150, frame))
    film.release()
    camera = f'[camera.front]\ndevice = "file:{folder / "cube.avi"}"\nwidth = 240\nheight = 240\nrate = 30.0\n'
    rig = folder / "cell.toml"
    rig.write_text((ROOT / "hw/rigs/xarm7.toml").read_text().replace("cameras = []", "") + camera)
    return rig


@pytest.mark.slow
@pytest.mark.timeout(200)
def test_a_real_scene_that_does_not_match_is_told_on_the_page_and_its_score_is_kept(fake: FakeXArm, tmp_path: Path):
    cv2.imwrite(str(tmp_path / "left.png"), scene(60, 99))
    plan = tmp_path / "cubes.toml"
    plan.write_text(
        'task = "lift"\nmax_attempts = 1\n' + METHODS + '[[scene]]\nname = "cube left"\nimage = "left.png"\n'
    )
    process = started(
        str(plan), "--robot", "xarm", "--rig", str(cell(tmp_path)), "--host", f"{fake.address}:{FAKE_PORT}",
        "--port", "0", "--no-rerun", "--recordings", str(tmp_path / "r"), "--full-speed",
    )  # fmt: skip
    try:
        assert process.stdout is not None
        line = next((line for line in process.stdout if "page is at" in line), "")
        assert line, process.stderr and process.stderr.read()
        client = RawClient(line.split()[-1])
        client.look()
        assert client.read(30, lambda: "not yet" in client.html("op-scene")), client.html("op-scene")
        ready = client.find("Scene ready")
        assert ready is not None and client.read(10, lambda: not client.widgets[ready].get("disabled"))
        client.press(ready)
        assert client.read(10, lambda: "press Scene ready once more" in client.html("op-events"))
        assert not begun(tmp_path / "r"), "nothing moved"
        client.press(ready)
        assert client.read(20, lambda: "trial 1: scene 0" in client.html("op-events"))
    finally:
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=40)
    assert process.returncode == 0, err
    (session,) = (tmp_path / "r").iterdir()
    (kept,) = [e.detail for e in read_session(session).log if e.event == "scene_matched"]
    assert kept["scene"] == "cube left" and kept["scores"]["front"] < kept["limit"]
    assert cv2.imread(str(session / kept["pictures"]["front"])).shape == (224, 224, 3)
