"""Faults of the program itself while a real arm moves: processes killed or frozen, the disk full. Does the arm hold, is
the recording readable, what does the operator read? Each time a whole `far run` of its own on the fake controller.
"""

from __future__ import annotations

import contextlib
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

from far_app.bench.servo_trace import servo_trace
from far_app.endpoints import Endpoints
from far_app.errors import FarError
from far_app.recording.inspect import inspect_session
from far_app.session.statistics import percentiles
from hw.fake_xarm.control import FakeXArm
from hw.fake_xarm.protocol import Function
from hw.rig import load_rig
from ui.raw_client import RawClient
from ui.stop import StopLine

PORT = 15502
START = 90.0
"""Seconds a run may take until the arm moves under the policy."""
FULL = 4096
"""Bytes beyond which no file of a run with a full disk may grow."""


@dataclass(kw_only=True)
class Struck:
    """A run whose arm moves, about to be struck."""

    process: subprocess.Popen[str]
    fake: FakeXArm
    url: str = ""
    """Of its page, where it has one."""
    page: RawClient | None = None
    stop_s: float | None = None
    """From STOP to its frame at the controller."""
    words: list[str] = field(default_factory=list)

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
    ends: bool = False
    """The run ends by it, with a message."""


def _freeze(run: Struck) -> None:
    run.process.send_signal(signal.SIGSTOP)


def _stop_frozen(run: Struck) -> None:
    """STOP as the page sends it, while the app is frozen."""
    run.fake.received()
    line = StopLine(Endpoints.in_folder(run.folder()))
    time.sleep(0.2)
    pressed = time.monotonic()
    line.press("bench")
    time.sleep(0.5)
    frames = [r for r in run.fake.received() if r["function"] == Function.SET_STATE and r["argument"] == 4]
    run.stop_s = frames[0]["at"] - pressed if frames else None
    run.words.append("STOP: latched" if line.result is not None and line.result.latched else "STOP: NOT CONFIRMED")
    line.close()


def _read_new_page(run: Struck) -> None:
    """What the page says that was started in the dead one's place."""
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline and not run.words:
        with contextlib.suppress(OSError):
            page = RawClient(run.url)
            page.read(3.0)
            run.words += [_reason(page)] * bool(_reason(page))
            page.close()
        time.sleep(0.2)


def _reason(page: RawClient) -> str:
    texts = " ".join(str(p.get("content", "")) for p in page.widgets.values())
    start = texts.find("nobody has had the page open")
    return texts[start : texts.find("<", start)] if start >= 0 else ""


def _fill_disk(run: Struck) -> None:
    resource.prlimit(run.process.pid, resource.RLIMIT_FSIZE, (FULL, FULL))


WHOLE_RUNS: dict[str, Blow] = {
    "app SIGKILL": Blow(strike=lambda r: r.process.kill()),
    "hw server SIGKILL": Blow(strike=lambda r: r.child("hw.server").kill(), ends=True),
    "page SIGKILL": Blow(strike=lambda r: r.child("ui.server").kill(), then=_read_new_page, seconds=4.0, page=True),
    "app frozen, then STOP": Blow(strike=_freeze, then=_stop_frozen),
    "disk full": Blow(strike=_fill_disk, seconds=3.0, ends=True),
}


def whole_runs(name: str, repeats: int, address: str, policy: str) -> dict[str, Any]:
    """The table's line."""
    shots = [_once(WHOLE_RUNS[name], _next(address), policy) for _ in range(repeats)]
    stops = [s["stop_s"] for s in shots if s["stop_s"] is not None]
    return {
        "times": len(shots),
        "hold_ms": percentiles([s["hold_s"] for s in shots], 1e3),
        "held": sum(s["held"] for s in shots),
        "stop_frame_ms": percentiles(stops, 1e3) if stops else None,
        "largest_step_mm": max(s["step_mm"] for s in shots),
        "targets_outside_box": sum(s["outside"] for s in shots),
        "recording_readable": sum(s["readable"] for s in shots),
        "seconds_lost": percentiles([s["lost_s"] for s in shots]),
        "operator_read": shots[-1]["words"],
    }


def _next(address: str) -> str:
    head, _, last = address.rpartition(".")
    return f"{head}.{int(last) + 1}"


def _once(blow: Blow, address: str, policy: str) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="far-bench-") as recordings:
        run = _started(blow, address, policy, Path(recordings))
        try:
            _wait_for_motion(run, Path(recordings))
            struck, wall = time.monotonic(), time.time()
            blow.strike(run)
            time.sleep(blow.seconds)
            trace = servo_trace(run.fake.servo_targets(), load_rig("xarm7").safety)
            blow.then(run)
            if blow.ends:
                run.words += run.process.communicate(timeout=60)[1].strip().splitlines()
        finally:
            run.process.kill()
            run.process.communicate()
            run.fake.close()
        (folder,) = Path(recordings).iterdir()
        steps = sum(a.steps for trial in inspect_session(folder).trials for a in trial.attempts)
        newest = max(path.stat().st_mtime for path in folder.rglob("*") if path.is_file())
    return {
        "hold_s": max(0.0, trace.last_motion - struck), "held": trace.last_motion < struck + blow.seconds - 0.3,
        "step_mm": trace.largest_step, "outside": trace.outside, "stop_s": run.stop_s,
        "readable": steps > 0, "lost_s": max(0.0, wall - newest), "words": run.words[-1] if run.words else "",
    }  # fmt: skip


def _started(blow: Blow, address: str, policy: str, recordings: Path) -> Struck:
    fake = FakeXArm.start(address, PORT)
    command = [sys.executable, "-uc", "import sys; from far_app.cli import main; sys.exit(main(sys.argv[1:]))"]
    command += ["run", "--robot", "xarm", "--host", f"{address}:{PORT}", "--no-rerun", "--full-speed"]
    command += ["--policy", policy, "--recordings", str(recordings), "--max-attempts", "100"]
    command += ["--port", "0"] if blow.page else ["--headless"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    run = Struck(process=process, fake=fake)
    if blow.page:
        assert process.stdout is not None
        run.url = process.stdout.readline().split()[-1]
        run.page = page = RawClient(run.url)
        page.look()
        page.read(START, lambda: any("Rebuild the scene" in str(p.get("content", "")) for p in page.widgets.values()))
        ready = page.find("Scene ready")
        if ready is None:
            raise FarError("the page never asked for the scene")
        page.press(ready)
    return run


def _wait_for_motion(run: Struck, recordings: Path) -> None:
    """Until an attempt is recorded and the arm is led about."""
    deadline = time.monotonic() + START
    while time.monotonic() < deadline and run.process.poll() is None:
        if run.page is not None:
            run.page.read(0.1)
        if any(recordings.rglob("*attempt*")):
            time.sleep(1.5)
            run.fake.received()
            return
        time.sleep(0.1)
    raise FarError(f"the run did not come to move the arm within {START:g} s (exit status {run.process.poll()})")
