"""What `far bench faults` makes of its shots, and the wall clock that it steps."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from far_app.bench.fault_report import BEGIN, END, markdown, row, write_into
from far_app.bench.faults import shots_in
from far_app.bench.recorded import lacking
from far_app.bench.whole_runs import stepped_clock
from far_app.errors import ConfigError

SHOT = {
    "held": True, "told_s": 0.03, "words": "C31: Collision", "outside": 0, "hold_s": 0.0, "step_mm": 1.5,
    "resumed": True, "first_mm": 0.0, "step_after_mm": 2.4, "lacking_s": 0.02,
}  # fmt: skip
STOP = SHOT | {"words": "STOP", "stop_s": 0.0008, "heard_s": 0.0003, "floor_s": 0.0001}
KILLED = {
    "held": True, "hold_s": 0.04, "words": "", "outside": 0, "step_mm": 0.8, "resumed": True, "first_mm": None,
    "lacking_s": None,
}  # fmt: skip


def attempt(ticks: list[int], start: float) -> Any:
    return SimpleNamespace(steps=tuple(SimpleNamespace(tick=t, deadline=start + t / 30) for t in ticks))


def test_a_row_tells_the_worst_of_its_shots_and_what_was_read_most_often() -> None:
    told = row([SHOT, SHOT | {"step_mm": 2.5, "outside": 3, "resumed": False}, SHOT | {"words": "C24"}])
    assert (told["times"], told["largest_step_mm"], told["targets_outside_box"], told["resumed"]) == (3, 2.5, 3, 2)
    assert told["operator_read"] == "C31: Collision" and told["stop_frame_ms"] is None


def test_the_table_has_every_fault_and_a_cell_for_every_column() -> None:
    table = markdown({"C31": row([SHOT]), "STOP": row([STOP, STOP]), "app SIGKILL": row([KILLED])})
    tables = [block.splitlines() for block in table.split("\n\n")]
    assert [len(lines) for lines in tables] == [5, 3], "faults, and STOP's frame apart"
    for lines in tables:
        assert len({line.count(" | ") for line in lines if "---" not in line}) == 1, lines
    assert "0.8 / 0.8" in tables[1][2] and "0.3 / 0.3" in tables[1][2]


def test_the_table_goes_between_its_marks_and_nowhere_else(tmp_path: Path) -> None:
    doc = tmp_path / "faults.md"
    doc.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    for _ in range(2):
        write_into(doc, "new")
        assert doc.read_text() == f"before\n{BEGIN}\nnew\n{END}\nafter\n"
    doc.write_text("no marks")
    with pytest.raises(ConfigError, match="has no place for the table"):
        write_into(doc, "new")


def test_it_goes_on_from_the_shots_of_before(tmp_path: Path) -> None:
    file = tmp_path / "faults.json"
    assert shots_in(file) == {}
    file.write_text(json.dumps({"faults": {}, "shots": {"STOP": [STOP]}}))
    assert shots_in(file) == {"STOP": [STOP]}
    file.write_text("[1]")
    with pytest.raises(ConfigError, match="holds no shots"):
        shots_in(file)


def test_a_recording_lacks_what_lies_between_its_newest_tick_and_the_event() -> None:
    recorded = [attempt([0, 1, 2], 10.0), attempt([0, 1, 2, 3, 4], 20.0)]
    assert lacking(recorded, 20.0 + 3.5 / 30) == pytest.approx(0.5 / 30)
    assert lacking(recorded, 21.0) == pytest.approx(1.0 - 4 / 30)
    assert lacking(recorded, 10.0 + 1 / 30) == pytest.approx(0.0, abs=1e-9)
    assert lacking([attempt([0, 2], 10.0)], 11.0) is None, "a tick is missing"
    assert lacking([], 11.0) is None


def test_a_stepped_wall_clock_is_seen_by_the_processes_of_a_run_and_their_monotonic_clock_goes_on(
    tmp_path: Path,
) -> None:
    clock = tmp_path / "clock"
    words = (
        "import pathlib, time; a, m = time.time(), time.monotonic(); "
        f"pathlib.Path({str(clock)!r}).write_text('3600'); "
        "print(time.time() - a, time.time_ns() / 1e9 - a, time.clock_gettime(time.CLOCK_REALTIME) - a, "
        "time.monotonic() - m, a)"
    )
    done = subprocess.run(
        [sys.executable, "-c", words], check=True, capture_output=True, text=True, env=stepped_clock(clock)
    )
    *wall, monotonic, before = map(float, done.stdout.split())
    assert all(abs(seen - 3600) < 60 for seen in wall) and monotonic < 60 and abs(before - time.time()) < 60
