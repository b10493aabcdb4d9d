"""`far report`: what a folder of results says, as Markdown and a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from far_app.report import markdown, read_folder


@dataclass(frozen=True, kw_only=True)
class ReportOptions:
    """Tables with intervals and tests (README.md), and success by attempt (success.png)."""

    results: tyro.conf.Positional[Path]
    """A folder that `far eval` or `far study` wrote."""
    out: Path | None = None
    """Where to write; the folder itself by default."""


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(ReportOptions, args=list(arguments), prog="far report")
    print(write_report(options.results, options.out or options.results))
    return 0


def write_report(folder: Path, target: Path) -> str:
    """The report of what is there so far; its text."""
    from far_app.report_plot import draw

    results = read_folder(folder)
    text = markdown(results)
    target.mkdir(parents=True, exist_ok=True)
    draw(results, target / "success.png")
    (target / "README.md").write_text(text + "\n![Success by attempt](success.png)\n")
    return text
