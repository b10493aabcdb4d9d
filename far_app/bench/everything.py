"""`far bench all`: every benchmark of speed, each in a process of its own, and docs/performance.md from their reports.

Resumable: a benchmark whose report is in the file is not run again, one that failed or was cut off is. A report is kept
as its benchmark wrote it; `rows_of` makes of it what the page shows.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tyro

from far_app.bench.report import keep
from far_app.bench.rows import Row
from far_app.errors import ConfigError, FarError

BENCHMARKS: dict[str, tuple[str, ...]] = {
    "infer": (), "render": (), "train": (), "evaluate": (), "start": (), "adapt": (),
    "adapt-paper": (
        "--policy", "untrained:paper", "--seed", "3", "--rounds", "10", "--plain-rounds", "3", "--growth", "",
    ),
    "page": ("--speed", "150"), "loop": ("--seconds", "120"),
    "loop-arm": ("--robot", "xarm", "--policy", "untrained:paper", "--engine", "openvino-bf16", "--seconds", "120"),
}  # fmt: skip
"""What runs, in this order, and with which arguments beside --json; last what needs most of the machine. What follows a
hyphen tells two runs of one benchmark apart. (Seed 3: on some scenes random weights drive the hand out of its box.)"""


@dataclass(frozen=True, kw_only=True)
class EverythingOptions:
    """Every benchmark of speed, and docs/performance.md; a second start goes on where the first one stopped."""

    json: Path
    """All reports; also where a second start finds those that are there."""
    only: tuple[str, ...] = ()
    """These benchmarks alone (loop, render, …)."""
    again: bool = False
    """Run those too that are in the file."""
    page: Path | None = Path("docs/performance.md")
    """Write the page here, its plot beside it."""
    device: str = "cpu"
    """Passed on to the benchmarks of networks."""

    def __post_init__(self) -> None:
        if unknown := set(self.only) - set(BENCHMARKS):
            raise ConfigError(f"no benchmark {', '.join(sorted(unknown))}; choose among: {', '.join(BENCHMARKS)}")


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(EverythingOptions, args=list(arguments), prog="far bench all")
    from far_app.bench.performance_page import write_page

    kept = resumed(options.json)
    failed = []
    for name in options.only or tuple(BENCHMARKS):
        if name in kept["reports"] and not options.again:
            print(f"{name}: in {options.json} already", flush=True)
            continue
        print(f"{name} …", flush=True)
        began = time.monotonic()
        try:
            kept["reports"][name] = run(name, BENCHMARKS[name], options.device)
        except FarError as error:
            print(f"{name}: {error}", file=sys.stderr, flush=True)
            failed.append(name)
            continue
        kept["seconds"][name] = round(time.monotonic() - began, 1)
        keep(kept, options.json)
    if options.page is not None and kept["reports"]:
        write_page(kept, options.page)
        print(f"wrote {options.page}", flush=True)
    if failed:
        raise FarError(f"{', '.join(failed)} failed; the others are in {options.json}, start again for these")
    return 0


def resumed(path: Path) -> dict[str, Any]:
    """What the file holds; {"machine", "reports": by benchmark, "seconds": what each took}. ConfigError where it was
    made on another machine: figures of two are never mixed in one page."""
    here = machine()
    if not path.exists():
        return {"machine": here, "reports": {}, "seconds": {}}
    try:
        kept = json.loads(path.read_text())
        there = kept["machine"]
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} is no file of far bench all ({error!r}); give another --json") from error
    if there != here:
        other = ", ".join(f"{k} {there.get(k)} (here {here[k]})" for k in here if there.get(k) != here[k])
        raise ConfigError(f"{path} was made elsewhere: {other}; give another --json")
    return kept


def machine() -> dict[str, str]:
    """What the figures are of."""
    import torch

    model = next(
        (line.split(":", 1)[1].strip() for line in _lines("/proc/cpuinfo") if line.startswith("model name")),
        platform.processor(),
    )
    return {
        "processor": f"{model}, {len(os.sched_getaffinity(0))} cores",
        "accelerator": torch.cuda.get_device_name() if torch.cuda.is_available() else "none",
        "system": f"{platform.system()} {platform.release()}", "python": platform.python_version(),
        "torch": torch.__version__,
    }  # fmt: skip


def run(name: str, arguments: Sequence[str], device: str) -> dict[str, Any]:
    """One benchmark's report. Raises FarError when it fails."""
    with tempfile.TemporaryDirectory(prefix="far-bench-") as folder:
        report = Path(folder) / "report.json"
        words = ["bench", name.split("-", maxsplit=1)[0], *arguments, "--json", str(report)]
        words += ["--device", device] * (name in ("infer", "train"))
        code = "import sys; from far_app.cli import main; sys.exit(main(sys.argv[1:]))"
        done = subprocess.run([sys.executable, "-c", code, *words], check=False, stdout=subprocess.DEVNULL)
        if done.returncode or not report.exists():
            raise FarError(f"far {' '.join(words[:2])} ended with {done.returncode} and left no report; see above")
        return json.loads(report.read_text())


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text().splitlines()
    except OSError:
        return []


def rows_of(name: str, report: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The benchmark's rows (far_app/bench/rows.py): its own, or for those whose reports are older than rows, what
    these amount to."""
    if "rows" in report:
        return list(report["rows"])
    if name.startswith("loop"):
        return loop_rows(report)
    if name == "infer":
        return [
            _row(f"a chunk, {r['preset']}, {r['engine']}", "ms", r["p50"], p99=r["p99"], repeats=r["calls"],
                 plain=round(r["p50"] * r["speedup"], 2), target=None if r["engine"] == "torch" else TICK)
            for r in report.get("chunks", ())
        ]  # fmt: skip
    if name in ADAPTATIONS:
        forms = {form["form"]: form for form in report.get("forms", ())}
        if "fast" not in forms:
            return []
        plain = forms["plain"]["seconds"]["p50"] if "plain" in forms else None
        fast = forms["fast"]
        what = "an adaptation, the loop running"
        return [
            _row(what, "s", fast["seconds"]["p50"], plain=plain, repeats=fast["rounds"], target=ADAPTATIONS[name]),
            _row("cancelling one", "ms", report["cancel_ms"]["p50"], p99=report["cancel_ms"]["p99"], target=CANCEL),
        ]  # fmt: skip
    raise KeyError(f"the report of {name} has no rows")


TICK = 33.3
"""Milliseconds within which a chunk replans every tick."""
ADAPTATIONS = {"adapt": 4.0, "adapt-paper": 10.0}
"""Seconds of an adaptation of the quickstart preset on two cores, and of the paper's."""
CANCEL = 100.0
"""Milliseconds until one is cancelled."""
EVERY_TICK = 1.0
"""Ticks from a plan's observation to its first action where every tick is planned anew."""
BEYOND = 2.0
"""Milliseconds that the loop may be later than a bare sleeper, at the 99.9th percentile."""
LOOP_TARGETS = {"record": 0.3, "publish": 0.2, "recorder": 0.3, "telemetry": 0.2}
"""Milliseconds a tick: of the stages on the loop's own thread, and of the threads that go on with what they were
handed."""


def loop_rows(report: Mapping[str, Any]) -> list[dict[str, Any]]:
    rows = []
    for phase in ("idle", "adapting"):
        found = report[phase]
        late, ticks = found["late_ms"], found["ticks"]
        rows.append(_row(f"{phase}: a target's lateness", "ms", late["p50"], p99=late["p99"], repeats=ticks))
        rows += [
            _row(f"{phase}: {what}", "ms", alone["p50"], p99=alone["p99"], repeats=found["floor"]["ticks"])
            for what, alone in (
                ("a bare sleeper's lateness in the meantime", found["floor"]["late_ms"]),
                ("what a fixed piece of work takes it", found["floor"]["work_ms"]),
            )
        ]
        beyond = round(late["p999"] - found["floor"]["late_ms"]["p999"], 3)
        rows.append(_row(f"{phase}: lateness beyond the sleeper's, 99.9 %", "ms", beyond, repeats=ticks, target=BEYOND))
        rows += [
            _row(f"{phase}: {stage}", "ms", ms["p50"], p99=ms["p99"], repeats=ticks, target=LOOP_TARGETS.get(stage))
            for stage, ms in found["stages_ms"].items()
            if ms["p50"] is not None
        ]  # fmt: skip
        age = found["plan_age_ticks"]
        rows.append(_row(f"{phase}: age of the plan acted on", "ticks", age["p50"], p99=age["p99"], repeats=ticks,
                         target=EVERY_TICK))  # fmt: skip
        rows += [
            _row(f"{phase}: the {thread} thread's processor time", "ms", ms, repeats=ticks, target=LOOP_TARGETS[thread])
            for thread, ms in found["threads_ms"].items()
        ]
    return rows


def _row(what: str, unit: str, fast: float, **known: Any) -> dict[str, Any]:
    return asdict(Row(what=what, unit=unit, fast=fast, **known))
