"""`far report`: what results or improvements say (Markdown and a picture), or recorded sessions (one HTML page)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from far_app.errors import ConfigError
from far_app.improvement_report import improvements_in
from far_app.report import markdown, read_folders


@dataclass(frozen=True, kw_only=True)
class ReportOptions:
    """Of results: tables with intervals and tests (README.md), and success by attempt (success.png). Of improvements:
    the same, by epoch. Of recorded sessions: a page with both, and every failure with its flagged moment."""

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """What `far eval` or `far study` wrote, or `far improve`, or recorded sessions; several share a table."""
    out: Path | None = None
    """Of results: the folder to write to, by default their own. Of sessions: the page, by default
    report_SESSION.html here."""
    overwrite: bool = False
    """Replace a page that exists."""
    unblind: bool = False
    """Name the methods of a blinded plan that is not done yet."""


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(ReportOptions, args=list(arguments), prog="far report")
    folders = list(options.folders)
    if not folders:
        raise ConfigError("nothing to report on; give a folder of far eval's results, or recorded sessions")
    improved, compared = ([f for f in folders if kind(f)] for kind in (improvements_in, results_in))
    if improved and len(improved) < len(folders):
        raise ConfigError(f"{improved[0]} is an improvement, not all of the others are; report on each kind by itself")
    if improved or compared:
        if len(folders) > 1 and options.out is None:
            raise ConfigError("several folders of results have no place for one report; give --out")
        write = write_improvements if improved else write_report
        print(write(folders, options.out or folders[0]))
    else:
        print(write_page(folders, options.out, options.overwrite, options.unblind))
    return 0


def results_in(folder: Path) -> bool:
    """Whether `far eval` or `far study` wrote it."""
    if (folder / "session.json").exists() or improvements_in(folder):
        return False
    return (folder / "plan.json").exists() or any(folder.glob("*/plan.json"))


def write_page(folders: Sequence[Path], out: Path | None, overwrite: bool, unblind: bool) -> Path:
    """Where the page of these sessions is."""
    from far_app.exchange.target import whole
    from far_app.recording.inspect import find_session
    from far_app.session_report.page import page

    sessions = list(dict.fromkeys(find_session(folder) for folder in folders))
    target = out or Path(f"report_{sessions[0].resolve().name}.html")
    with whole(target, overwrite) as half:
        half.write_text(page(sessions, unblind=unblind), encoding="utf-8")
    return target


def write_report(folders: Sequence[Path], target: Path) -> str:
    """The report of what is there so far; its text."""
    from far_app.report_plot import draw

    results = read_folders(folders)
    target.mkdir(parents=True, exist_ok=True)
    draw(results, target / "success.png")
    return written(markdown(results), "![Success by attempt](success.png)", target)


def write_improvements(folders: Sequence[Path], target: Path) -> str:
    """The report of what `far improve` found so far; its text."""
    from far_app.improvement_report import curves, draw, markdown

    found = curves(folders)
    target.mkdir(parents=True, exist_ok=True)
    draw(found, target / "improvement.png")
    return written(markdown(found), "![Success by episodes and ticks](improvement.png)", target)


def written(text: str, picture: str, target: Path) -> str:
    """The tables, to the folder's page with their picture below."""
    (target / "README.md").write_text(f"{text}\n{picture}\n")
    return text
