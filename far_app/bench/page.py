"""`far bench page`: what do open pages cost the loop, and does the page's process grow over a day?

Lateness: the whole application on the twin, phases without and with clients on its page in turn, so that a machine that
is busy for a while is so for both. Memory: the page's process alone, a made day of telemetry replayed to it at a
multiple of its speed (far_app/bench/replayed_day.py), two raw clients reading all of it; its resident size each second.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from far_app.bench.loop import floor, naive_trials
from far_app.bench.report import keep, write
from far_app.bench.rows import Row, table
from far_app.bench.waiting import came_true
from far_app.cli.options import RunOptions
from far_app.cli.settings import recommended
from far_app.cli.stage import stage
from far_app.errors import ConfigError, FarError
from far_app.session.statistics import LoopStatistics, percentiles
from ui.raw_client import RawClient

CLIENTS = 2
RISE, GROWTH = 0.5, 200.0
"""At most: milliseconds that these add to p99 lateness, MB that the page's process grows over the day."""


@dataclass(frozen=True, kw_only=True)
class PageOptions:
    """Lateness with and without open pages; memory over a replayed day."""

    part: Literal["both", "lateness", "memory"] = "both"
    seconds: float = 30.0
    """Of each phase without clients, and of each with them."""
    rounds: int = 4
    """Pairs of phases."""
    chromium: Path | None = None
    """A browser in place of raw clients: on the same cores it is the browser that is measured."""
    hours: float = 10.0
    """Of the replayed day."""
    speed: float = 20.0
    """Times faster than it was."""
    json: Path | None = None
    """Write the report here."""

    def __post_init__(self) -> None:
        if self.seconds < 5 or self.rounds < 1:
            raise ConfigError(f"--seconds {self.seconds:g} --rounds {self.rounds}: at least 5 and 1")
        if self.hours <= 0 or self.speed <= 0:
            raise ConfigError(f"--hours {self.hours:g} --speed {self.speed:g}: must be above 0")


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(PageOptions, args=list(arguments), prog="far bench page")
    report: dict[str, Any] = {"clients": CLIENTS, "kind": "chromium" if options.chromium else "raw"}
    if options.part != "memory":
        report["lateness"] = lateness(options)
        keep(report, options.json)
    if options.part != "lateness":
        report["memory"] = memory(options)
    write(report | {"rows": table(rows(report))}, options.json)
    return 0


def rows(report: dict[str, Any]) -> list[Row]:
    """What docs/performance.md shows of it."""
    made = []
    if "lateness" in report:
        late = report["lateness"]
        made.append(
            Row(what="what two open pages add to a target's lateness, p99", unit="ms", fast=late["p99_rise_ms"],
                repeats=late["ticks"], target=RISE)
        )  # fmt: skip
    if "memory" in report:
        day = report["memory"]
        what = f"growth of the page's process over {day['hours']:g} replayed hours"
        made.append(Row(what=what, unit="MB", fast=day["growth_mb"], repeats=day["seconds"], target=GROWTH))
    return made


def lateness(options: PageOptions) -> dict[str, Any]:
    """p99 of each phase and of all phases of a kind together, for the loop and for a bare sleeper beside it: where the
    sleeper's rises as well, it is the machine that was busy."""
    late: dict[str, list[float]] = {"without": [], "with": []}
    spans: dict[str, list[tuple[float, float]]] = {"without": [], "with": []}
    rounds: list[dict[str, float | None]] = []
    with tempfile.TemporaryDirectory(prefix="far-bench-") as recordings:
        run = RunOptions(
            port=0, method="far", rerun=False, recordings=Path(recordings), retry=recommended(RunOptions.task, None)
        )
        with stage(run) as stage_, floor(stage_.task.rate) as woken:
            for _ in range(options.rounds):
                of_round: dict[str, float | None] = {}
                for kind in late:
                    with clients(stage_.page_url, options.chromium) if kind == "with" else contextlib.nullcontext():
                        began = time.monotonic()
                        statistics = naive_trials(stage_, options.seconds)[0]
                        spans[kind].append((began, time.monotonic()))
                    of_round[kind] = _p99(statistics)
                    late[kind] += statistics.late
                rounds.append(of_round)
    loop = {kind: percentiles(values, 1e3) for kind, values in late.items()}
    bare = {
        kind: percentiles([lag for due, lag, _ in woken if any(a <= due <= b for a, b in spans[kind])], 1e3)
        for kind in spans
    }
    return {
        "ticks": len(late["without"]) + len(late["with"]), "late_ms": loop, "floor_ms": bare, "p99_ms_by_round": rounds,
        "p99_rise_ms": _rise(loop), "floor_p99_rise_ms": _rise(bare),
    }  # fmt: skip


def _rise(late: dict[str, dict[str, float | None]]) -> float:
    return round(_of(late["with"]) - _of(late["without"]), 3)


def _p99(statistics: LoopStatistics) -> float | None:
    return percentiles(statistics.late, 1e3)["p99"]


def _of(late: dict[str, float | None]) -> float:
    p99 = late["p99"]
    if p99 is None:
        raise FarError("no target was acknowledged, so there is no lateness to compare; measure for longer")
    return p99


@contextlib.contextmanager
def clients(url: str, chromium: Path | None = None) -> Iterator[list[subprocess.Popen[bytes]]]:
    """So many on the page while inside. Raises FarError when one lost its connection."""
    with contextlib.ExitStack() as stack:
        started = []
        for _ in range(CLIENTS):
            command = [sys.executable, "-m", "ui.raw_client", url, "--seconds", "1000000"]
            if chromium is not None:
                profile = stack.enter_context(
                    tempfile.TemporaryDirectory(prefix="far-browser-", ignore_cleanup_errors=True)
                )
                command = [str(chromium), "--headless=new", "--no-sandbox", "--remote-debugging-port=0"]
                command += [f"--user-data-dir={profile}", "--window-size=1280,720", url]
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            stack.callback(_end, process)
            started.append(process)
        time.sleep(3.0)
        yield started
        if any(process.poll() is not None for process in started):
            raise FarError("a client lost the page during the measurement; measure again")


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def memory(options: PageOptions) -> dict[str, Any]:
    """Resident size of the page's process over the day, MB."""
    with tempfile.TemporaryDirectory(prefix="far-day-") as name, contextlib.ExitStack() as stack:
        port = _free_port()
        url = f"http://127.0.0.1:{port}"
        command = [sys.executable, "-m", "ui.server", "--run-folder", name, "--port", str(port), "--no-rerun"]
        page = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        stack.callback(_end, page)
        if not came_true(lambda: _listens(port), 60.0):
            raise FarError("the page did not come up within 60 s; try again when the machine is less busy")
        day = [sys.executable, "-m", "far_app.bench.replayed_day", name]
        replay = subprocess.Popen([*day, "--hours", str(options.hours), "--speed", str(options.speed)])
        stack.callback(_end, replay)
        readers = stack.enter_context(clients(url))
        sizes = [resident(page.pid)]
        _shows_the_day(url)
        while replay.poll() is None:
            time.sleep(1.0)
            sizes.append(resident(page.pid))
            if any(reader.poll() is not None for reader in readers):
                raise FarError("a client lost the page during the replay; measure again")
    half = sizes[len(sizes) // 2 :]
    rate = float(np.polyfit(np.arange(len(half)), half, 1)[0]) if len(half) > 2 else 0.0
    return {
        "hours": options.hours, "speed": options.speed, "seconds": len(sizes) - 1, "start_mb": round(sizes[0], 1),
        "end_mb": round(sizes[-1], 1), "largest_mb": round(max(sizes), 1), "growth_mb": round(sizes[-1] - sizes[0], 1),
        "second_half_mb_per_minute": round(60 * rate, 2),
    }  # fmt: skip


def _shows_the_day(url: str) -> None:
    """Raises FarError when the page does not show what is replayed: its memory would mean nothing."""
    client = RawClient(url)
    try:
        if not client.read(20.0, lambda: "replayed" in client.html("op-loop")):
            raise FarError("the page does not show the replayed day; measure again when the machine is less busy")
    finally:
        client.close()


def resident(pid: int) -> float:
    """MB of memory that a process holds."""
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0
