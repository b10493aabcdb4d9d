"""`far doctor`: one line for each thing the application stands on, with what to do where it is lacking.

With --rig it checks one rig file and its controller instead (far_app/cli/doctor_rig.py).
"""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from far_app.cli.ports import choose_port
from far_app.errors import FarError

PACKAGES = (
    "numpy", "torch", "mujoco", "robosuite", "numba", "opencv-python-headless", "pyzmq", "msgpack", "viser",
    "rerun-sdk", "safetensors", "mcap", "tyro",
)  # fmt: skip
RENDER_LIMIT_MS = 10.0
"""Milliseconds a policy picture may cost on two cores."""
SLEEP_LIMIT_MS = 5.0
DISK_LIMIT_GB = 2.0


@dataclass(frozen=True, kw_only=True)
class Finding:
    good: bool
    text: str
    advice: str = ""


def main(arguments: Sequence[str]) -> int:
    """Exit status 1 when something needed is lacking."""
    parser = argparse.ArgumentParser(prog="far doctor", description="What this machine has, and what to do about it.")
    parser.add_argument("--port", type=int, default=8080, help="the page's port")
    parser.add_argument("--policy", help="checkpoint whose engine is told; the shipped model by default")
    parser.add_argument("--device", default="cpu", help="cpu or cuda, for the engine")
    parser.add_argument("--recordings", type=Path, default=Path("recordings"))
    parser.add_argument(
        "--rig", help="check this rig file (name or path) instead, its cameras, and its controller where one answers"
    )
    parser.add_argument("--host", default="", help="ADDRESS[:PORT] of the controller, over the rig file's")
    options = parser.parse_args(list(arguments))
    if options.rig is not None:
        from far_app.cli.doctor_rig import check_rig

        return check_rig(options.rig, options.host)
    checks: tuple[tuple[str, Callable[[], Finding]], ...] = (
        ("Python", python),
        ("packages", packages),
        ("OpenCV", opencv),
        ("CPU", cpu),
        ("GPU", gpu),
        ("torch", torch_device),
        ("engine", lambda: engine(options.policy, options.device)),
        ("GL", graphics),
        ("timer", timer),
        ("disk", lambda: disk(options.recordings)),
        ("ports", lambda: ports(options.port)),
    )
    well = True
    for name, check in checks:
        try:
            finding = check()
        except Exception as error:  # a doctor names what is broken and goes on
            finding = Finding(good=False, text=f"{type(error).__name__}: {error}", advice="see the README's set-up")
        well = well and finding.good
        advice = f"  → {finding.advice}" if finding.advice else ""
        print(f"{'ok ' if finding.good else 'BAD'}  {name:<9} {finding.text}{advice}", flush=True)
    return 0 if well else 1


def python() -> Finding:
    good = sys.version_info >= (3, 11)
    return Finding(
        good=good, text=f"{platform.python_version()} at {sys.executable}",
        advice="" if good else "install Python 3.11 or newer, remove .venv, run make again",
    )  # fmt: skip


def packages() -> Finding:
    versions, missing = [], []
    for name in PACKAGES:
        try:
            versions.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
    if missing:
        return Finding(good=False, text=f"missing: {', '.join(missing)}", advice="run make run, it installs them")
    return Finding(good=True, text=", ".join(versions))


def opencv() -> Finding:
    import cv2

    names = {d.metadata["Name"].lower() for d in importlib.metadata.distributions()}
    windowed = sorted(names & {"opencv-python", "opencv-contrib-python"})
    gui = next(
        (line.split(":", 1)[1].strip() for line in cv2.getBuildInformation().splitlines() if "GUI:" in line), "?"
    )
    if windowed:
        return Finding(
            good=False, text=f"{cv2.__version__}, but {', '.join(windowed)} is installed over the headless build",
            advice=f"pip uninstall {' '.join(windowed)}, then pip install --force-reinstall opencv-python-headless",
        )  # fmt: skip
    return Finding(good=True, text=f"{cv2.__version__}, headless (GUI: {gui})")


def cpu() -> Finding:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    load = os.getloadavg()[0]
    name = next((line.split(":", 1)[1].strip() for line in _cpuinfo() if line.startswith("model name")), "CPU")
    good = cores >= 2
    advice = "" if good else "two cores are needed: one for the hardware server, one for the app"
    if good and load > cores:
        advice = "the machine is busy: the loop will be late; end what else runs"
    return Finding(good=good, text=f"{cores} cores, load {load:.1f}, {name}", advice=advice)


def gpu() -> Finding:
    tool = shutil.which("nvidia-smi")
    if tool is None:
        return Finding(good=True, text="none seen (not needed for the quickstart model)")
    query = [tool, "--query-gpu=name,driver_version", "--format=csv,noheader"]
    found = subprocess.run(query, capture_output=True, text=True, timeout=10, check=False).stdout.strip()
    return Finding(good=True, text=found.replace("\n", "; ") or "nvidia-smi lists none")


def torch_device() -> Finding:
    import torch

    device = f"cuda: {torch.cuda.get_device_name(0)}" if torch.cuda.is_available() else "cpu"
    return Finding(good=True, text=f"{torch.__version__}, device {device}, {torch.get_num_threads()} threads")


def engine(policy: str | None, device: str) -> Finding:
    """What a run of this policy would take: measured, built and checked as a run does it."""
    from far_app.cli.assemble import load_model
    from far_app.learning.engines import ENGINES

    model = load_model(policy, None, "lift", device, ["nr"])
    taken = model.base.runs_on
    absent = [f"{n} ({why})" for n, e in ENGINES.items() if (why := e.unusable(model.network))]
    return Finding(
        good=not taken.refused, text=f"a run of {model.name} takes {taken.name} ({taken.why})",
        advice="; ".join([f"refused: {r}" for r in taken.refused] + [f"not here: {', '.join(absent)}"] * bool(absent)),
    )  # fmt: skip


def graphics() -> Finding:
    """Renders the twin's cameras in a process of its own: a broken GL driver may take its process down."""
    script = (
        "import time\nfrom far_app.tasks import task\nfrom hw.rig import load_rig\n"
        "from hw.server import make_plant\nrig = load_rig('twin')\nt = task('lift')\n"
        "plant, make_view = make_plant(rig, t)\nview = make_view()\ns = plant.snapshot()\n"
        "n = len(t.cameras)\n[view.image(s, c, rig.policy_image) for c in t.cameras for _ in range(3)]\n"
        "b = time.perf_counter()\n[view.image(s, c, rig.policy_image) for _ in range(30) for c in t.cameras]\n"
        "ms = (time.perf_counter() - b) / 30 / n * 1e3\n"
        "from OpenGL import GL\nprint(f'{ms:.1f}|{GL.glGetString(GL.GL_RENDERER).decode()}')\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=False)
    backend = os.environ.get("MUJOCO_GL", "egl")
    if done.returncode != 0:
        words = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        return Finding(
            good=False, text=f"back end {backend} cannot render: {words}",
            advice="sudo apt-get install libegl1 libgl1 libegl-mesa0 libgl1-mesa-dri",
        )  # fmt: skip
    ms, renderer = done.stdout.strip().splitlines()[-1].split("|")
    slow = float(ms) > RENDER_LIMIT_MS
    return Finding(
        good=True, text=f"{backend} on {renderer}, {ms} ms a picture",
        advice=f"above {RENDER_LIMIT_MS:g} ms pictures come late: free the cores or use a GPU" if slow else "",
    )  # fmt: skip


def timer() -> Finding:
    """How late a sleeper wakes at 30 Hz, over a second."""
    late, due = [], time.monotonic() + 1 / 30
    for _ in range(30):
        time.sleep(max(0.0, due - time.monotonic()))
        late.append((time.monotonic() - due) * 1e3)
        due += 1 / 30
    late.sort()
    bad = late[-1] > SLEEP_LIMIT_MS
    return Finding(
        good=True, text=f"a 30 Hz sleeper wakes {late[15]:.2f} ms late (median), {late[-1]:.2f} ms at worst",
        advice="other programs keep the cores; ticks will be late" if bad else "",
    )  # fmt: skip


def disk(recordings: Path) -> Finding:
    folder = recordings.absolute()
    while not folder.exists():
        folder = folder.parent
    free = shutil.disk_usage(folder).free / 1e9
    good = free >= DISK_LIMIT_GB
    advice = "" if good else f"free at least {DISK_LIMIT_GB:g} GB, or record elsewhere with --recordings"
    return Finding(good=good, text=f"{free:.1f} GB free for {recordings}", advice=advice)


def ports(port: int) -> Finding:
    try:
        choose_port("127.0.0.1", port)
    except FarError as error:
        return Finding(good=False, text=f"{port} is taken", advice=str(error))
    return Finding(good=True, text=f"{port} is free")


def _cpuinfo() -> list[str]:
    try:
        return Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return []
