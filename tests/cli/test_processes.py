"""The run's processes: nothing is left behind, whatever ends it. Real processes, the twin, a scripted policy."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from far_app.recording.inspect import find_session, inspect_session

FAR = Path(sys.executable).parent / "far"
pytestmark = pytest.mark.slow


class Run:
    """`far run` with a scripted policy, in a process of its own."""

    def __init__(self, folder: Path, *words: str, page: bool = True) -> None:
        self.folder = folder
        self.log = folder / "log"
        command = [str(FAR), "run", "--policy", "test:wander", "--recordings", str(folder / "recordings"), *words]
        command += ["--port", "0"] if page else ["--headless"]
        environment = os.environ | {"TMPDIR": str(folder), "OMP_NUM_THREADS": "1"}
        with self.log.open("wb") as output:
            self.process = subprocess.Popen(
                command, stdout=output, stderr=output, stdin=subprocess.DEVNULL, env=environment, start_new_session=True
            )

    def text(self) -> str:
        return self.log.read_text(errors="replace")

    def until(self, condition, limit: float = 90.0) -> None:
        deadline = time.monotonic() + limit
        while not condition():
            assert time.monotonic() < deadline, self.text()
            time.sleep(0.05)

    def until_moving(self) -> None:
        """An attempt's file grows."""
        self.until(lambda: any(p.stat().st_size > 200_000 for p in (self.folder / "recordings").glob("*/*/*.mcap")))

    def children(self) -> dict[str, psutil.Process]:
        found = {}
        for child in psutil.Process(self.process.pid).children(recursive=True):
            with contextlib.suppress(psutil.NoSuchProcess):
                words = " ".join(child.cmdline())
                for name in ("hw.server", "ui.server"):
                    if name in words:
                        found[name] = child
        return found

    def descendants(self) -> list[psutil.Process]:
        return psutil.Process(self.process.pid).children(recursive=True)

    def sockets_folder_gone(self) -> bool:
        return not list(self.folder.glob("far-*"))


@pytest.fixture
def start(tmp_path):
    runs = []

    def start(*words: str, **kwargs) -> Run:
        runs.append(Run(tmp_path, *words, **kwargs))
        return runs[-1]

    yield start
    for run in runs:
        with contextlib.suppress(psutil.NoSuchProcess):
            for child in psutil.Process(run.process.pid).children(recursive=True):
                child.kill()
        run.process.kill()
        run.process.wait(10)


def all_gone(processes, limit: float = 20.0) -> bool:
    _, alive = psutil.wait_procs(list(processes), timeout=limit)
    return not alive


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_sigterm_end_everything_and_close_the_recording(start, ending):
    run = start()
    run.until_moving()
    children = run.children()
    assert set(children) == {"hw.server", "ui.server"}
    everyone = run.descendants()
    run.process.send_signal(ending)
    assert run.process.wait(60) == 0, run.text()
    assert all_gone(everyone)
    assert run.sockets_folder_gone()
    report = inspect_session(find_session(run.folder / "recordings"))
    assert report.sound and report.state == "closed", report


def test_sigkill_of_the_app_leaves_no_orphan_and_a_readable_recording(start):
    run = start()
    run.until_moving()
    everyone = run.descendants()
    assert len(everyone) >= 3, "hardware, page, .rrd maker"
    run.process.kill()
    run.process.wait(10)
    assert all_gone(everyone)
    report = inspect_session(find_session(run.folder / "recordings"))
    assert report.state == "cut off" and report.trials[0].attempts[0].steps > 5


def test_a_dead_page_comes_back_and_the_loop_does_not_notice(start):
    run = start("--trials", "1", "--max-attempts", "2")
    run.until_moving()
    page = run.children()["ui.server"]
    page.kill()
    run.until(lambda: (c := run.children().get("ui.server")) is not None and c.pid != page.pid, limit=20)
    assert run.process.wait(90) == 0, run.text()


def test_the_hw_servers_death_is_a_fault_that_ends_a_headless_run_with_an_error(start):
    run = start(page=False)
    run.until_moving()
    run.children()["hw.server"].kill()
    assert run.process.wait(30) == 2, run.text()
    last = run.text().strip().splitlines()[-1]
    assert last.startswith("far: ") and "the hardware process ended with status -9" in last
    report = inspect_session(find_session(run.folder / "recordings"))
    (trial,) = report.trials
    assert trial.attempts[-1].outcome == "failure" and trial.attempts[-1].judged_by == "fault"


def test_nan_from_the_policy_ends_a_headless_run_with_an_error_and_a_closed_recording(start):
    run = start("--policy", "test:nan", page=False)
    assert run.process.wait(90) == 2, run.text()
    last = run.text().strip().splitlines()[-1]
    assert "planned a non-finite action at tick" in last
    report = inspect_session(find_session(run.folder / "recordings"))
    assert report.state == "closed" and report.trials[0].attempts[0].judged_by == "fault"


def test_the_summary_has_exactly_the_promised_fields(start, tmp_path):
    summary = tmp_path / "summary.json"
    run = start("--trials", "1", "--seed", "3", "--max-attempts", "1", "--summary-json", str(summary), page=False)
    assert run.process.wait(120) == 0, run.text()
    told = json.loads(summary.read_text())
    assert set(told) == {"trials", "ticks", "late_ms", "overruns", "starved"}
    assert told["trials"] == [{"seed": 3, "attempts": 1, "success": False, "judged_by": "horizon"}]
    assert set(told["late_ms"]) == {"p50", "p99", "p999", "max"} and told["ticks"] == 150
