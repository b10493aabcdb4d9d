"""`far bench faults`: everything that can go wrong with a real arm, again and again, on the fake controller.

For each fault: milliseconds until the last servo target that moved (then the arm holds), the largest servo step, how
many targets left the workspace box, whether the recording holds all that came before, what the operator read, whether
Resume led on, and how far its first target lay from where the arm stood. Most strike one session again and again
(far_app/bench/session_faults.py); what ends or freezes a process strikes runs of its own (far_app/bench/whole_runs.py).

Every shot is kept in the JSON file as it is made; started again with the same file it makes those that still lack.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from far_app.bench.fault_report import markdown, row, write_into
from far_app.bench.fault_table import FAULTS
from far_app.bench.report import keep
from far_app.bench.session_faults import struck
from far_app.bench.whole_runs import WHOLE_RUNS, whole_run
from far_app.errors import ConfigError, FarError

Shots = dict[str, list[dict[str, Any]]]


@dataclass(frozen=True, kw_only=True)
class FaultOptions:
    """Faults of a real arm on the fake controller, each many times."""

    json: Path | None = None
    """Keep every shot and the table here; go on from what it holds already."""
    doc: Path | None = None
    """A Markdown file (docs/faults.md) into which the table is written, between its marks."""
    repeats: int = 20
    only: tuple[str, ...] = ()
    """Names of faults; all by default."""
    minutes: float = math.inf
    """Begin nothing after so long: a part of the whole, to be gone on with later."""
    address: str = "127.0.0.77"
    """Loopback address for the fake controller; the next one is used too."""
    policy: str = "test:wander"


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(FaultOptions, args=list(arguments), prog="far bench faults")
    known = (*FAULTS, *WHOLE_RUNS)
    names = options.only or known
    if unknown := [n for n in names if n not in known]:
        raise FarError(f"unknown fault {', '.join(unknown)}; choose from: {', '.join(known)}")
    shots = shots_in(options.json)
    try:
        measure(options, names, shots)
    finally:
        report = report_of(shots, known)
        keep(report, options.json)
    print(markdown(report["faults"]), flush=True)
    if lacking := [f"{n} {len(shots.get(n, ()))}/{options.repeats}" for n in names if _left(options, n, shots)]:
        print(f"\nStill lacking: {', '.join(lacking)}; the same command goes on with them.", flush=True)
    if options.doc is not None:
        write_into(options.doc, markdown(report["faults"]))
    return 0


def measure(options: FaultOptions, names: Sequence[str], shots: Shots) -> None:
    """Add the shots that lack, as far as the time goes."""
    until = time.monotonic() + 60.0 * options.minutes
    known = (*FAULTS, *WHOLE_RUNS)
    for camera in (False, True):
        chosen = [n for n in names if n in FAULTS and FAULTS[n].camera is camera and _left(options, n, shots)]
        if chosen and time.monotonic() < until:
            struck(chosen, shots, options.repeats, options.address, options.policy, until)
            keep(report_of(shots, known), options.json)
    for name in (n for n in names if n in WHOLE_RUNS):
        while _left(options, name, shots) and time.monotonic() < until:
            shots.setdefault(name, []).append(whole_run(WHOLE_RUNS[name], options.address, options.policy))
            keep(report_of(shots, known), options.json)


def shots_in(file: Path | None) -> Shots:
    """Those made before. Raises ConfigError for a file that is something else."""
    if file is None or not file.exists():
        return {}
    try:
        return dict(json.loads(file.read_text())["shots"])
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{file} holds no shots of far bench faults ({error}); give another file") from error


def report_of(shots: Shots, order: Sequence[str]) -> dict[str, Any]:
    return {"faults": {name: row(shots[name]) for name in order if shots.get(name)}, "shots": shots}


def _left(options: FaultOptions, name: str, shots: Shots) -> int:
    return max(0, options.repeats - len(shots.get(name, ())))
