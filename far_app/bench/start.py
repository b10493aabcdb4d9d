"""`far bench start`: seconds from a command to what one waits for: the list of commands, the arm's first motion."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from far_app.bench.report import write
from far_app.bench.rows import REPEATS, Row, table
from far_app.errors import ConfigError, FarError

FAR = (sys.executable, "-c", "import sys; from far_app.cli import main; sys.exit(main(sys.argv[1:]))")
MOVES = "→ running"
"""What the log says when the arm begins to follow the policy."""


@dataclass(frozen=True, kw_only=True)
class StartOptions:
    """Seconds until something happens, from a second start on (the first one fills caches and is not counted)."""

    repeats: int = REPEATS
    """Of far --help."""
    starts: int = 5
    """Of far run; each takes many seconds."""
    json: Path | None = None
    """Write the report here."""

    def __post_init__(self) -> None:
        if self.repeats < 1 or self.starts < 1:
            raise ConfigError(f"--repeats {self.repeats}, --starts {self.starts}: at least 1 each")


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(StartOptions, args=list(arguments), prog="far bench start")
    told = [seconds_to_help() for _ in range(options.repeats + 1)][1:]
    moved = [seconds_to_motion() for _ in range(options.starts + 1)][1:]
    rows = [_row("far --help", told, 0.5), _row("far run, the twin: first motion", moved, 10.0)]
    write({"rows": table(rows)}, options.json)
    return 0


def _row(what: str, seconds: Sequence[float], target: float) -> Row:
    p50, p99 = np.percentile(seconds, (50, 99)).round(2).tolist()
    return Row(what=what, unit="s", fast=p50, p99=p99, repeats=len(seconds), target=target)


def seconds_to_help() -> float:
    began = time.monotonic()
    subprocess.run([*FAR, "--help"], check=True, stdout=subprocess.DEVNULL)
    return time.monotonic() - began


def seconds_to_motion() -> float:
    """From the command until the first attempt's first tick; then the run is ended."""
    with tempfile.TemporaryDirectory(prefix="far-bench-") as folder:
        words = ["run", "--trials", "1", "--headless", "--verbose", "--recordings", folder]
        began = time.monotonic()
        process = subprocess.Popen([*FAR, *words], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        assert process.stderr is not None
        last = ""
        try:
            for line in process.stderr:
                last = line
                if MOVES in line:
                    return time.monotonic() - began
        finally:
            process.terminate()
            process.stderr.close()
            process.wait(30.0)
    raise FarError(f"far run ended before the arm moved: {last.strip() or 'it said nothing'}")
