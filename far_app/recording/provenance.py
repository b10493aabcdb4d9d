"""Where a recording comes from: the code's version and the machine, gathered once at a session's start."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path

from far_app.recording.codec import Json

_PACKAGES = ("numpy", "torch", "mujoco", "robosuite", "mcap", "opencv-python-headless", "rerun-sdk", "viser")


def code_version() -> str:
    """The package's version, with the commit when it runs from a git checkout and "-dirty" when files differ."""
    version = _package_version("far-app") or "unknown"
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return version
    commit = _git(root, "rev-parse", "--short=12", "HEAD")
    if not commit:
        return version
    dirty = _git(root, "status", "--porcelain", "--untracked-files=no")
    return f"{version}+g{commit}{'-dirty' if dirty else ''}"


def host_facts() -> dict[str, Json]:
    """The machine without its name or its user's: system, processor, cores, memory, versions."""
    packages = {name: version for name in _PACKAGES if (version := _package_version(name))}
    pages, page = os.sysconf("SC_PHYS_PAGES"), os.sysconf("SC_PAGE_SIZE")
    return {
        "system": f"{_distribution()}, Linux {platform.release().split('-')[0]} {platform.machine()}",
        "real_time_kernel": "PREEMPT_RT" in platform.version(),
        "processor": _processor(),
        "cpus": len(os.sched_getaffinity(0)),
        "memory_gb": round(pages * page / 1e9, 1),
        "python": platform.python_version(),
        "packages": packages,
    }


def _distribution() -> str:
    try:
        return platform.freedesktop_os_release().get("PRETTY_NAME", "")
    except OSError:
        return platform.system()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def _package_version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""


def _git(root: Path, *arguments: str) -> str:
    try:
        result = subprocess.run(
            ["git", "-C", str(root), *arguments], capture_output=True, text=True, timeout=5, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return result.stdout.strip() if result.returncode == 0 else ""
