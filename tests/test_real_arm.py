"""`far run --robot xarm` whole: its processes, its page and its recording, on the fake controller."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from far_app.recording.inspect import find_session, inspect_session
from far_app.recording.reader import read_session
from hw.fake_xarm.control import FakeXArm
from hw.fake_xarm.protocol import Function
from tests.hw.conftest import FAKE_PORT, loopback
from ui.raw_client import RawClient

ROOT = Path(__file__).parent.parent
STEP = 2.5 + 1e-3


@pytest.fixture
def fake() -> Iterator[FakeXArm]:
    fake = FakeXArm.start(loopback(), FAKE_PORT)
    yield fake
    fake.close()


class Run:
    """`far run` and its page, read and pressed as a browser would."""

    def __init__(self, fake: FakeXArm, recordings: Path, *words: str, server: tuple[str, ...] = ()) -> None:
        """`server`: words that name an hw server on another machine in place of one of its own."""
        self.fake = fake
        command = [sys.executable, "-u", "-c", "import sys; from far_app.cli import main; sys.exit(main(sys.argv[1:]))"]
        server = server or ("--host", f"{fake.address}:{FAKE_PORT}")
        command += ["run", "--robot", "xarm", *server, "--policy", "test:wander"]
        command += ["--port", "0", "--no-rerun", "--recordings", str(recordings), *words]
        self.process = subprocess.Popen(
            command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, stdin=subprocess.DEVNULL
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert "page is at" in line, (line, self.process.stderr and self.process.stderr.read())
        self.page = RawClient(line.split()[-1])
        self.page.look()

    def shows(self, *words: str, seconds: float = 20.0) -> None:
        """The page comes to show all of these words."""
        refused: list[str] = []

        def shown() -> bool:
            text = self.text()
            refused.extend(re.findall(r"\w[\w ]* refused: [^<]*", text)[:1])
            return all(w in text for w in words)

        if not self.page.read(seconds, shown):
            told = f" (in between it told: {refused[-1]})" if refused else ""
            raise AssertionError(f"the page never showed {words}{told}; it shows: {self.text()[-3000:]}")

    def text(self) -> str:
        contents = (str(p.get("content", "")) for p in self.page.widgets.values())
        return "\n".join(c for c in contents if "<style" not in c)

    def press(self, label: str) -> None:
        uuid = self.page.find(label)
        assert uuid is not None, label
        assert self.page.read(5.0, lambda: not self.page.widgets[uuid].get("disabled")), f"{label} stays disabled"
        self.page.press(uuid)

    def close(self) -> tuple[int, str]:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        _, err = self.process.communicate(timeout=30)
        return self.process.returncode, err


def eventually(what: Callable[[], bool], seconds: float = 10.0) -> None:
    deadline = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < deadline, "it never came to that"
        time.sleep(0.05)


def moves(fake: FakeXArm) -> float:
    """Largest servo step of the last half second, millimetres."""
    fake.received()
    time.sleep(0.5)
    path = np.array([t["pose"][:3] for t in fake.servo_targets()])
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).max(initial=0.0)) if len(path) else 0.0


@pytest.mark.slow
def test_the_operator_leads_a_session_on_a_real_arm_through_the_page(fake: FakeXArm, tmp_path: Path) -> None:
    run = Run(fake, tmp_path, "--trials", "1")
    try:
        run.shows("Rebuild the scene, clear the workspace")
        assert moves(fake) == 0.0, "nothing moves before the operator says so"
        run.press("Scene ready")
        run.shows("attempt 1 at 1/2 speed, not counted")
        run.shows("1/2 of the policy")
        eventually(lambda: moves(fake) > 0.2)

        fake.error(31)
        run.shows("C31: Collision Caused Abnormal Current")
        assert moves(fake) == 0.0
        run.press("Resume")
        run.shows("begins in 3 s: Pause or STOP cancels")
        eventually(lambda: 0.2 < moves(fake) < STEP)

        run.page.close()
        time.sleep(4.0)
        assert moves(fake) == 0.0, "two seconds without a page hold the arm"
        time.sleep(1.0)
        assert moves(fake) == 0.0, "for as long as nobody resumes"
    finally:
        code, err = run.close()
    assert code == 0, err
    found = inspect_session(find_session(tmp_path))
    assert found.sound, found.problems
    assert [a.judged_by for a in found.trials[0].attempts][:1] == ["fault"]


@pytest.mark.slow
def test_the_death_of_the_app_holds_the_arm_and_leaves_a_readable_recording(fake: FakeXArm, tmp_path: Path) -> None:
    run = Run(fake, tmp_path, "--full-speed")
    run.shows("Rebuild the scene")
    run.press("Scene ready")
    run.shows("begins in 3 s: Pause or STOP cancels")
    eventually(lambda: moves(fake) > 0.5)
    run.page.read(1.0)
    fake.received()
    killed = time.monotonic()
    run.process.kill()
    time.sleep(1.0)
    targets = fake.servo_targets()
    path, at = np.array([t["pose"][:3] for t in targets]), np.array([t["at"] for t in targets])
    size = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert size.max() < STEP
    assert at[1:][size > 0.02].max(initial=killed) - killed < 0.5
    run.process.wait()
    found = inspect_session(find_session(tmp_path))
    assert found.trials[0].attempts[0].steps > 10


def stop_while_the_app_is_frozen(run: Run, fake: FakeXArm) -> None:
    """STOP pressed then stops the arm, and is told and left by Resume when the app goes on."""
    try:
        run.shows("Rebuild the scene")
        run.press("Scene ready")
        run.shows("begins in 3 s: Pause or STOP cancels")
        eventually(lambda: moves(fake) > 0.5)
        run.process.send_signal(signal.SIGSTOP)
        eventually(lambda: moves(fake) == 0.0)
        run.press("STOP")
        time.sleep(0.5)
        assert [r for r in fake.received() if r["function"] == Function.SET_STATE and r["argument"] == 4]
        assert fake.state()["state"] == 4
        run.process.send_signal(signal.SIGCONT)
        run.shows("STOPPED", "arm latched")
        run.press("Resume")
        run.shows("begins in 3 s: Pause or STOP cancels")
    finally:
        run.process.send_signal(signal.SIGCONT)
        code, err = run.close()
    assert code == 0, err


@pytest.mark.slow
def test_stop_from_the_page_reaches_the_controller_while_the_app_is_frozen(fake: FakeXArm, tmp_path: Path) -> None:
    stop_while_the_app_is_frozen(Run(fake, tmp_path, "--full-speed"), fake)


@pytest.mark.slow
def test_what_fails_on_a_real_arm_is_learnt_from_and_retried_as_in_the_twin(fake: FakeXArm, tmp_path: Path) -> None:
    """The shipped model on the rehearsal rig, whose cameras show it no cube."""
    command = [sys.executable, "-c", "import sys; from far_app.cli import main; sys.exit(main(sys.argv[1:]))", "run"]
    command += ["--rig", "rehearsal", "--host", f"{fake.address}:{FAKE_PORT}", "--accept-differences", "--headless"]
    command += ["--full-speed", "--trials", "1", "--max-attempts", "2", "--no-rerun", "--recordings", str(tmp_path)]
    command += ["--retry.perturbation.first-attempt", "2"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr
    first, second = read_session(find_session(tmp_path)).attempts()
    assert first.outcome is not None and not first.outcome.success
    assert first.adaptation is not None and first.adaptation.status == "adapted" and first.adaptation.pairs > 0
    assert {step.policy_version for step in second.steps} == {first.adaptation.version}
    assert not np.any([step.perturbation for step in first.steps])
    nudges = np.array([step.perturbation for step in second.steps])
    assert nudges[:, :3].any() and not nudges[:, 3:].any(), "of x, y and z only"
    path = np.array([target["pose"][:3] for target in fake.servo_targets()])
    assert 1.0 < np.linalg.norm(np.diff(path, axis=0), axis=1).max() < STEP
