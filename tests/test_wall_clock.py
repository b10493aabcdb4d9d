"""A step of the wall clock (NTP, an operator, summer time) must not matter: only metadata may read it."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
READERS = {
    ("time", "time"), ("time", "time_ns"), ("time", "localtime"), ("time", "gmtime"), ("time", "ctime"),
    ("time", "strftime"), ("datetime", "now"), ("datetime", "utcnow"), ("datetime", "today"), ("date", "today"),
    ("time", "CLOCK_REALTIME"),
}  # fmt: skip
METADATA = {"far_app/recording/session_folder.py", "far_app/recording/said_lines.py"}
"""The session's name and start, and the wall clock beside the monotonic one, once a session; when an operator's word
was said."""
MODULES = sorted(p for folder in ("far_app", "hw", "ui") for p in (ROOT / folder).rglob("*.py"))


def reads_wall_clock(path: Path) -> list[str]:
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            found += [f"{node.value.id}.{node.attr}"] * ((node.value.id, node.attr) in READERS)
        elif isinstance(node, ast.ImportFrom) and node.module == "time":
            found += [f"from time import {a.name}" for a in node.names if ("time", a.name) in READERS]
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_only_metadata_and_benchmarks_read_the_wall_clock(path: Path):
    name = str(path.relative_to(ROOT))
    if name in METADATA or name.startswith("far_app/bench/"):
        return
    assert not reads_wall_clock(path), f"{name}: a step of the wall clock would reach it; use time.monotonic"


def test_reading_it_would_be_seen(tmp_path: Path):
    (tmp_path / "a.py").write_text("import time\nfrom time import time_ns\nnow = time.time()\n")
    assert sorted(reads_wall_clock(tmp_path / "a.py")) == ["from time import time_ns", "time.time"]
