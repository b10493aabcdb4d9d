"""SIGKILL of the app, of the hw server, and of the page's process while a real arm moves: does the arm hold, is the
recording readable? Each time a whole `far run` of its own on the fake controller."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from far_app.errors import FarError
from far_app.recording.inspect import inspect_session
from far_app.session.statistics import percentiles
from hw.fake_xarm.control import FakeXArm

PORT = 15502
KILLED = {"app SIGKILL": "", "hw server SIGKILL": "hw.server"}
"""By name: the module of the process that is killed; the app itself where it is empty."""
START = 90.0
"""Seconds a run may take until the arm moves under the policy."""
MOVED = 0.02
HELD = 1.5
"""Seconds looked at after the kill."""


def killed(name: str, repeats: int, address: str, policy: str) -> dict[str, Any]:
    """The table's line."""
    shots = [_once(KILLED[name], _next(address), policy) for _ in range(repeats)]
    return {
        "times": len(shots),
        "hold_ms": percentiles([s["hold_s"] for s in shots], 1e3),
        "largest_step_mm": round(max(s["step_mm"] for s in shots), 3),
        "recording_readable": sum(s["readable"] for s in shots),
        "seconds_lost": percentiles([s["lost_s"] for s in shots]),
        "operator_read": shots[-1]["words"],
    }


def _next(address: str) -> str:
    head, _, last = address.rpartition(".")
    return f"{head}.{int(last) + 1}"


def _once(module: str, address: str, policy: str) -> dict[str, Any]:
    fake = FakeXArm.start(address, PORT)
    with tempfile.TemporaryDirectory(prefix="far-bench-") as recordings:
        command = [sys.executable, "-c", "import sys; from far_app.cli import main; sys.exit(main(sys.argv[1:]))"]
        command += ["run", "--robot", "xarm", "--host", f"{address}:{PORT}", "--headless", "--no-rerun", "--full-speed"]
        command += ["--policy", policy, "--recordings", recordings, "--max-attempts", "100"]
        run = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        try:
            _wait_for_motion(fake, run, Path(recordings))
            victim = _victim(run.pid, module)
            struck, wall = time.monotonic(), time.time()
            victim.send_signal(signal.SIGKILL)
            time.sleep(HELD)
            targets = fake.servo_targets()
            words = run.communicate(timeout=30)[1].strip().splitlines() if module else [""]
        finally:
            run.kill()
            run.wait()
            fake.close()
        (folder,) = Path(recordings).iterdir()
        found = inspect_session(folder)
        steps = sum(a.steps for trial in found.trials for a in trial.attempts)
        newest = max(path.stat().st_mtime for path in folder.rglob("*") if path.is_file())
    path, at = np.array([t["pose"][:3] for t in targets]), np.array([t["at"] for t in targets])
    size = np.linalg.norm(np.diff(path, axis=0), axis=1)
    moved = at[1:][size > MOVED]
    return {
        "hold_s": max(0.0, float(moved[-1] - struck)) if len(moved) else 0.0, "step_mm": float(size.max(initial=0.0)),
        "readable": steps > 0, "lost_s": max(0.0, wall - newest), "words": words[-1] if words else "",
    }  # fmt: skip


def _wait_for_motion(fake: FakeXArm, run: subprocess.Popen[str], recordings: Path) -> None:
    """Until an attempt is recorded and the arm is led about."""
    deadline = time.monotonic() + START
    while time.monotonic() < deadline and run.poll() is None:
        if any(recordings.rglob("*attempt*")):
            time.sleep(1.5)
            fake.received()
            return
        time.sleep(0.1)
    raise FarError(f"the run did not come to move the arm within {START:g} s (exit status {run.poll()})")


def _victim(pid: int, module: str) -> psutil.Process:
    parent = psutil.Process(pid)
    if not module:
        return parent
    for child in parent.children(recursive=True):
        if module in child.cmdline():
            return child
    raise FarError(f"the run has no process {module}")
