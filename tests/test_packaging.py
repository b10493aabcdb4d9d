"""What pyproject.toml, constraints.txt and the Makefile promise."""

from __future__ import annotations

import importlib.metadata
import re
import subprocess
import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
CONSTRAINTS = dict(
    line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if line and line[0] != "#"
)


def test_every_package_is_listed():
    listed = set(PROJECT["tool"]["setuptools"]["packages"])
    found = {
        ".".join(folder.relative_to(ROOT).parts)
        for name in ("far_app", "hw", "ui")
        for folder in (ROOT / name, *(ROOT / name).rglob("*"))
        if folder.is_dir() and list(folder.glob("*.py"))
    }
    assert listed == found


def test_every_dependency_is_bounded_and_its_pinned_version_lies_within():
    extras = PROJECT["project"]["optional-dependencies"]
    for text in (*PROJECT["project"]["dependencies"], *(line for extra in extras.values() for line in extra)):
        requirement = Requirement(text)
        assert "<" in str(requirement.specifier) and ">=" in str(requirement.specifier), f"{text} is not bounded"
        pinned = {name.lower().replace("_", "-"): v for name, v in CONSTRAINTS.items()}[requirement.name.lower()]
        assert Version(pinned) in requirement.specifier, (
            f"constraints.txt pins {requirement.name} {pinned}, not in {text}"
        )


def test_what_is_installed_is_what_the_constraints_say():
    for name, version in CONSTRAINTS.items():
        try:
            installed = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
        assert installed.split("+")[0] == version, name


def test_only_the_headless_opencv_is_installed():
    names = {d.metadata["Name"].lower() for d in importlib.metadata.distributions()}
    assert "opencv-python-headless" in names
    assert not names & {"opencv-python", "opencv-contrib-python", "opencv-contrib-python-headless"}


def test_make_hands_arguments_on_to_far_run():
    recipe = subprocess.run(
        ["make", "-n", "run", "ARGS=--trials 1 --headless"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    assert re.search(r"far run --trials 1 --headless$", recipe, re.MULTILINE)


def test_nothing_tracked_is_pickled():
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    assert not [f for f in tracked if Path(f).suffix in (".pkl", ".pickle", ".pt", ".pth", ".ckpt")]
