"""Faults of the program itself while a real arm moves: processes killed or frozen, the disk full, the wall clock
stepped. Each time a whole `far run` of its own on the fake controller, and its recording read afterwards.
"""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from far_app.bench import wall_clock
from far_app.bench.page_death import read_new_page, resume_there
from far_app.bench.presser import Press, Presser
from far_app.bench.recorded import attempts_in, lacking
from far_app.bench.servo_trace import servo_trace
from far_app.bench.session_faults import PORT
from far_app.errors import FarError
from hw.fake_xarm.control import FakeXArm
from hw.fake_xarm.protocol import Function
from hw.rig import load_rig
from ui.raw_client import RawClient

START = 90.0
"""Seconds a run may take until the arm moves under the policy."""
FULL = 4096
"""Bytes beyond which no file of a run with a full disk may grow."""
HOUR, DAY = 3600.0, 86400.0


@dataclass(kw_only=True)
class Struck:
    """A run whose arm moves, about to be struck."""

    process: subprocess.Popen[str]
    fake: FakeXArm
    clock: Path
    """File with the seconds by which the run's wall clock is off."""
    url: str = ""
    """Of its page, where it has one."""
    page: RawClient | None = None
    press: Press | None = None
    """Of STOP."""
    resumed: bool | None = None
    """Whether the operator led on in the same run; None where the run is over."""
    first: float | None = None
    """Millimetres from where the arm stood to the first target after that."""
    words: list[str] = field(default_factory=list)
    family: list[psutil.Process] = field(default_factory=list)
    """Its processes, once it runs."""

    def child(self, module: str) -> psutil.Process:
        for process in psutil.Process(self.process.pid).children(recursive=True):
            if module in process.cmdline():
                return process
        raise FarError(f"the run has no process {module}")

    def folder(self) -> Path:
        """Where its sockets lie."""
        words = self.child("hw.server").cmdline()
        return Path(words[words.index("--folder") + 1])


@dataclass(frozen=True, kw_only=True)
class Blow:
    strike: Callable[[Struck], object]
    then: Callable[[Struck], object] = lambda run: None
    """After the arm was watched."""
    seconds: float = 1.5
    """For which it is watched."""
    page: bool = False
    """It needs a page that somebody looks at."""
    holds: bool = True
    """The arm is to hold; else the run is to go on."""
    ends: bool = False
    """The run ends by it, with a message."""


def _stop_frozen(run: Struck) -> None:
    """STOP as the page sends it, while the app is frozen."""
    presser = Presser(run.folder())
    run.process.send_signal(signal.SIGSTOP)
    time.sleep(0.05)  # the watchdog has not held the arm yet
    run.press = presser.press()
    presser.close()
    run.words.append("STOP: latched" if run.press.heard is not None else "STOP: NOT CONFIRMED")


def _page_dies(run: Struck) -> None:
    """The operator reads the page that is started in its place, and presses Resume there."""
    page = read_new_page(run.url)
    run.words += [page.words] if page is not None else []
    run.first = resume_there(page, run.fake) if page is not None else None
    run.resumed = run.first is not None


def _fill_disk(run: Struck) -> None:
    resource.prlimit(run.process.pid, resource.RLIMIT_FSIZE, (FULL, FULL))


def _step_clock(run: Struck) -> None:
    """An hour ahead, then a day back."""
    for off_by in (HOUR, -DAY):
        run.clock.write_text(str(off_by))
        time.sleep(0.5)


WHOLE_RUNS: dict[str, Blow] = {
    "app SIGKILL": Blow(strike=lambda r: r.process.kill()),
    "hw server SIGKILL": Blow(strike=lambda r: r.child("hw.server").kill(), ends=True),
    "page SIGKILL": Blow(strike=lambda r: r.child("ui.server").kill(), then=_page_dies, seconds=4.0, page=True),
    "app frozen, then STOP": Blow(strike=_stop_frozen),
    "disk full": Blow(strike=_fill_disk, seconds=3.0, ends=True),
    "wall clock stepped": Blow(strike=_step_clock, holds=False, seconds=1.0),
}


def whole_run(blow: Blow, address: str, policy: str) -> dict[str, Any]:
    """One run and its shot, as far_app/bench/session_faults.py has them."""
    with tempfile.TemporaryDirectory(prefix="far-bench-") as folder:
        recordings = Path(folder) / "recordings"
        run = _started(blow, address, policy, Path(folder))
        try:
            _wait_for_motion(run, recordings)
            struck = time.monotonic()
            blow.strike(run)
            struck = run.press.pressed if run.press is not None else struck
            time.sleep(blow.seconds)
            received = run.fake.received()
            blow.then(run)
            if blow.ends:
                run.words += run.process.communicate(timeout=60)[1].strip().splitlines()
            elif not blow.holds:
                run.resumed = run.process.poll() is None
            _end(run)
            again = {} if run.resumed is not None else _start_again(run.fake)
        finally:
            _end(run)
            run.fake.close()
        lacks = lacking(attempts_in(recordings), struck)
    trace = servo_trace(
        [r for r in received if r["function"] == Function.MOVE_SERVO_CART_AA], load_rig("xarm7").safety
    )  # fmt: skip
    stops = [r["at"] for r in received if r["function"] == Function.SET_STATE and r["argument"] == 4]
    held = trace.last_motion < struck + blow.seconds - 0.3
    shot = {
        "held": held, "hold_s": max(0.0, trace.last_motion - struck) if held else None,
        "words": run.words[-1].replace(folder, "…") if run.words else "", "step_mm": trace.largest_step,
        "outside": trace.outside,
        "lacking_s": lacks, "resumed": bool(run.resumed), "first_mm": run.first,
    } | again  # fmt: skip
    if (press := run.press) is not None:
        shot["stop_s"] = stops[0] - press.pressed if stops else None
        shot["heard_s"] = stops[0] - press.heard if stops and press.heard is not None else None
        shot["floor_s"] = press.floor
    return shot


def _end(run: Struck) -> None:
    """With all its processes; its hw server holds the arm and goes by itself, before the next run asks for the arm."""
    if run.process.poll() is None:
        run.process.kill()
        run.process.communicate()
    _, left = psutil.wait_procs(run.family, timeout=10.0)
    for process in left:
        process.kill()
    if run.page is not None:
        run.page.close()
        run.page = None


def _start_again(fake: FakeXArm) -> dict[str, Any]:
    """What a new hw server does first on the arm that the last one left: nothing is to move."""
    deadline = time.monotonic() + 10.0
    while fake.state()["connections"] > 0 and time.monotonic() < deadline:
        time.sleep(0.1)  # the old one is on its way out
    fake.received()
    stood = np.array(fake.state()["position"])
    command = [sys.executable, "-m", "hw.server", "--rig", "xarm7", "--parent", str(os.getpid())]
    with tempfile.TemporaryDirectory(prefix="far-bench-") as folder:
        process = subprocess.Popen(
            [*command, "--folder", folder, "--address", f"{fake.address}:{PORT}"], stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL, text=True,
        )  # fmt: skip
        assert process.stdout is not None
        ready = '"ready"' in process.stdout.readline()
        time.sleep(0.3)
        targets = fake.servo_targets()
        process.terminate()
        process.wait(timeout=10.0)
    first = servo_trace(targets, load_rig("xarm7").safety).first
    return {"resumed": ready, "first_mm": float(np.linalg.norm(first - stood)) if len(targets) else None}


def stepped_clock(clock: Path) -> Mapping[str, str]:
    """Of a run whose wall clock can be stepped."""
    return os.environ | {"PYTHONPATH": str(Path(wall_clock.__path__[0])), "FAR_BENCH_CLOCK": str(clock)}


def _started(blow: Blow, address: str, policy: str, folder: Path) -> Struck:
    fake = FakeXArm.start(next_address(address), PORT)
    clock = folder / "clock"
    command = [sys.executable, "-uc", "import sys; from far_app.cli import main; sys.exit(main(sys.argv[1:]))"]
    command += ["run", "--robot", "xarm", "--host", f"{fake.address}:{PORT}", "--no-rerun", "--full-speed"]
    command += ["--policy", policy, "--recordings", str(folder / "recordings"), "--max-attempts", "100"]
    command += ["--port", "0"] if blow.page else ["--headless"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=stepped_clock(clock)
    )
    run = Struck(process=process, fake=fake, clock=clock)
    if blow.page:
        run.url = _address_of_page(run)
        run.page = page = RawClient(run.url)
        page.look()
        page.read(START, lambda: any("Rebuild the scene" in str(p.get("content", "")) for p in page.widgets.values()))
        ready = page.find("Scene ready")
        if ready is None:
            raise FarError("the page never asked for the scene")
        page.press(ready)
    return run


def _address_of_page(run: Struck) -> str:
    """What the run prints once its page is there. Raises FarError, with its last words, when it ended before."""
    assert run.process.stdout is not None
    if words := run.process.stdout.readline().split():
        return words[-1]
    said = run.process.communicate(timeout=START)[1].strip().splitlines()[-1:]
    _end(run)
    run.fake.close()
    raise FarError(f"the run ended before its page was there; it said: {''.join(said)}")


def next_address(address: str) -> str:
    head, _, last = address.rpartition(".")
    return f"{head}.{int(last) + 1}"


def _wait_for_motion(run: Struck, recordings: Path) -> None:
    """Until an attempt is recorded and the arm is led about."""
    deadline = time.monotonic() + START
    while time.monotonic() < deadline and run.process.poll() is None:
        if run.page is not None:
            run.page.read(0.1)
        if any(recordings.rglob("*attempt*")):
            time.sleep(1.5)
            run.family = psutil.Process(run.process.pid).children(recursive=True)
            run.fake.received()
            return
        time.sleep(0.1)
    run.process.kill()
    said = run.process.communicate()[1].strip().splitlines()[-1:]
    raise FarError(f"the run did not come to move the arm within {START:g} s; it said: {''.join(said)}")
