"""far bench all: every benchmark has its rows, a second start runs what is missing, two machines are never mixed."""

import json
from pathlib import Path

import pytest

from far_app.bench import everything
from far_app.bench.everything import BENCHMARKS, main, rows_of
from far_app.bench.performance_page import text, write_page
from far_app.bench.rows import Row, row_of, table, timed_side_by_side
from far_app.cli import COMMANDS
from far_app.errors import ConfigError, FarError
from far_app.types import TICK_STAGES

PHASE = {
    "ticks": 900, "late_ms": {"p50": 0.1, "p99": 2.0, "p999": 3.0},
    "floor": {"ticks": 1000, "late_ms": {"p50": 0.05, "p99": 0.1, "p999": 0.4}, "work_ms": {"p50": 0.2, "p99": 0.9}},
    "threads_ms": {"recorder": 0.2, "telemetry": 0.1}, "plan_age_ticks": {"p50": 2.0, "p99": 3.0},
    "stages_ms": {s: {"p50": 0.1 * (i + 1), "p99": 1.0, "mean": 0.2} for i, s in enumerate(TICK_STAGES)}
    | {"filter": {"p50": None, "p99": None, "mean": None}},
}  # fmt: skip
REPORTS = {
    "loop": {"idle": PHASE, "adapting": PHASE},
    "infer": {"chunks": [{"preset": "paper", "engine": "openvino", "p50": 20.0, "p99": 30.0, "speedup": 4.0,
                          "calls": 60}],
              "growth": [{"grows": "batch", "to": 2, "p50": 9.5}]},
    "adapt": {"forms": [{"form": "fast", "rounds": 5, "seconds": {"p50": 3.0}},
                        {"form": "plain", "rounds": 2, "seconds": {"p50": 12.0}}],
              "cancel_ms": {"p50": 20.0, "p99": 60.0}, "growth": []},
}  # fmt: skip
REPORTS["adapt-paper"] = REPORTS["adapt"]
REPORTS["loop-arm"] = REPORTS["loop"]


def report(name: str) -> dict:
    some = Row(what=f"{name} itself", unit="ms", fast=2.0, plain=6.0, p99=3.0, target=2.5)
    return REPORTS.get(name, {"rows": table([some])})


@pytest.fixture
def ran(monkeypatch) -> list[str]:
    """What was run; nothing really is."""
    calls: list[str] = []
    monkeypatch.setattr(everything, "run", lambda name, arguments, device: calls.append(name) or report(name))
    return calls


def test_every_benchmark_it_runs_is_a_command():
    assert all(f"bench {name.split('-')[0]}" in COMMANDS for name in BENCHMARKS)


def test_a_second_start_runs_what_is_missing(tmp_path: Path, ran):
    file, page = tmp_path / "all.json", tmp_path / "performance.md"
    main(["--json", str(file), "--page", str(page), "--only", "render", "train"])
    main(["--json", str(file), "--page", str(page)])
    assert ran[:2] == ["render", "train"] and sorted(ran) == sorted(BENCHMARKS)
    main(["--json", str(file), "--page", str(page), "--only", "train", "--again"])
    assert ran[-1] == "train" and len(ran) == len(BENCHMARKS) + 1
    kept = json.loads(file.read_text())
    assert set(kept["reports"]) == set(BENCHMARKS)
    assert (tmp_path / "performance_ticks.png").stat().st_size > 5_000


def test_what_failed_is_told_and_run_again(tmp_path: Path, monkeypatch):
    broken = {"render"}

    def run(name: str, arguments, device: str) -> dict:
        if name in broken:
            raise FarError(f"far bench {name} ended with 2")
        return report(name)

    monkeypatch.setattr(everything, "run", run)
    words = ["--json", str(tmp_path / "all.json"), "--page", str(tmp_path / "p.md")]
    with pytest.raises(FarError, match="render failed; the others are in"):
        main(words)
    assert "Training" in (tmp_path / "p.md").read_text() and "Drawing" not in (tmp_path / "p.md").read_text()
    broken.clear()
    assert main(words) == 0
    assert "Drawing" in (tmp_path / "p.md").read_text()


def test_figures_of_two_machines_are_never_mixed(tmp_path: Path, ran):
    file = tmp_path / "all.json"
    main(["--json", str(file), "--page", str(tmp_path / "p.md"), "--only", "train"])
    kept = json.loads(file.read_text())
    kept["machine"]["processor"] = "another"
    file.write_text(json.dumps(kept))
    with pytest.raises(ConfigError, match=r"made elsewhere: processor another \(here"):
        main(["--json", str(file)])
    file.write_text("[]")
    with pytest.raises(ConfigError, match="no file of far bench all"):
        main(["--json", str(file)])
    with pytest.raises(ConfigError, match="no benchmark lop; choose among: infer"):
        main(["--json", str(file), "--only", "lop"])


def test_the_page_says_ratio_and_whether_the_target_was_reached(tmp_path: Path):
    kept = {"machine": {"processor": "x, 2 cores"}, "reports": {n: report(n) for n in BENCHMARKS}, "seconds": {}}
    write_page(kept, tmp_path / "performance.md")
    page = (tmp_path / "performance.md").read_text()
    assert "| render itself | 2 ms | 6 | 3.0 | 3 | ≤ 2.5 ✓ | 30 |" in page
    assert "| a chunk, paper, openvino | 20 ms | 80 | 4.0 | 30 | ≤ 33.3 ✓ | 60 |" in page
    assert "| an adaptation, the loop running | 3 s | 12 | 4.0 |" in page
    assert "| idle: record | 0.6 ms | |" in page.replace("|  |", "| |") and "≤ 0.3 not reached" in page
    assert "| idle: lateness beyond the sleeper's, 99.9 % | 2.6 ms |" in page, "3.0 and 0.4"
    assert page.count("| adapting: age of the plan acted on | 2 ticks |  |  | 3 | ≤ 1 not reached |") == 2
    assert "## The tick, the real driver and the paper's network" in page
    assert "| adapting: what a fixed piece of work takes it | 0.2 ms |  |  | 0.9 |" in page
    assert "Learning from a failure, the paper's network" in page and "≤ 10 ✓" in page
    assert "idle: filter" not in page, "a stage nobody measured has no row"
    assert "performance_ticks.png" in page and "| batch | 2 | 9.5 |" in page
    assert "performance_ticks.png" not in text(kept | {"reports": {"train": report("train")}}, "")


def test_more_is_better_where_it_is():
    row = Row(what="x", unit="1/s", fast=30.0, plain=10.0, target=25.0, better="more")
    assert (row.ratio, row.reached) == (3.0, True)
    assert Row(what="x", unit="ms", fast=30.0, plain=10.0, target=25.0).reached is False
    assert Row(what="x", unit="ms", fast=30.0).ratio is None


def test_a_report_without_rows_is_refused():
    with pytest.raises(KeyError, match="train has no rows"):
        rows_of("train", {})


def test_both_forms_take_turns_and_the_warm_up_does_not_count():
    calls: list[str] = []
    plain, fast = timed_side_by_side(lambda: calls.append("p"), lambda: calls.append("f"), repeats=4, warm_up=2)
    assert "".join(calls) == "pf" * 6 and len(plain) == len(fast) == 4
    assert row_of("x", [1.0, 2.0, 9.0], [4.0, 4.0, 4.0]).fast == 2.0
