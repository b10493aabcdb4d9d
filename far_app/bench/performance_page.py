"""docs/performance.md from the reports of `far bench all`: the machine, the figures, a plot of each tick's stages."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from far_app.bench.everything import rows_of
from far_app.bench.rows import Row
from far_app.types import TICK_STAGES

TITLES = {
    "loop": "The tick", "loop-arm": "The tick, the real driver and the paper's network", "render": "Drawing the twin",
    "infer": "A chunk", "adapt": "Learning from a failure",
    "adapt-paper": "Learning from a failure, the paper's network", "train": "Training", "evaluate": "Evaluation",
    "start": "Starting",
}  # fmt: skip


def write_page(kept: Mapping[str, Any], page: Path) -> None:
    """The page, and its plot beside it where the loop was measured."""
    plot = page.with_name(f"{page.stem}_ticks.png")
    if "loop" in kept["reports"]:
        draw(kept["reports"]["loop"], plot)
    page.write_text(text(kept, plot.name if plot.exists() else ""), encoding="utf-8")


def text(kept: Mapping[str, Any], plot: str) -> str:
    """The whole page as Markdown."""
    parts = [
        "# How fast it is", "",
        "Made by `far bench all --json FILE`, not by hand. Each row's plain form is the readable reference in the "
        "code, measured in the same run as the fast one. Medians after a warm-up; ratios travel between machines, "
        "milliseconds do not.", "",
        "| machine | |", "|---|---|", *(f"| {k} | {v} |" for k, v in kept["machine"].items()),
    ]  # fmt: skip
    for name, title in TITLES.items():
        if name not in kept["reports"]:
            continue
        report = kept["reports"][name]
        parts += ["", f"## {title}", ""]
        if name == "loop" and plot:
            parts += [f"![Milliseconds of each stage of a tick]({plot})", ""]
        parts += [
            "| | fast | plain | × | 99 % | target | repeats |", "|---|---|---|---|---|---|---|",
            *(_line(Row(**row)) for row in rows_of(name, report)),
        ]  # fmt: skip
        if growth := report.get("growth"):
            parts += ["", *grown(growth)]
    return "\n".join(parts) + "\n"


def _line(row: Row) -> str:
    def told(value: float | None, unit: str = "") -> str:
        return "" if value is None else f"{value:.4g}{unit}"

    at = "≤" if row.better == "less" else "≥"
    target = "" if row.target is None else f"{at} {row.target:.4g} {'✓' if row.reached else 'not reached'}"
    ratio = "" if row.ratio is None else f"{row.ratio:.1f}"
    return (
        f"| {row.what} | {told(row.fast, ' ' + row.unit)} | {told(row.plain)} | {ratio} | {told(row.p99)} | {target} "
        f"| {row.repeats} |"
    )


def grown(growth: list[dict[str, Any]]) -> list[str]:
    """How cost grows: a row a value, the rows' own keys as columns."""
    keys = [k for k in growth[0] if not isinstance(growth[0][k], dict)]
    lines = ["How it grows:", "", f"| {' | '.join(keys)} |", "|" + "---|" * len(keys)]
    return lines + [f"| {' | '.join(str(row.get(k, '')) for k in keys)} |" for row in growth]


def draw(report: Mapping[str, Any], path: Path) -> None:
    """Each stage's median and 99th percentile, idle and adapting, against a tick of 33.3 ms."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(8, 3.4), layout="constrained")
    for k, phase in enumerate(("idle", "adapting")):
        found = report[phase]["stages_ms"]
        places = [i + 0.36 * k for i in range(len(TICK_STAGES))]
        p50 = [found[stage]["p50"] or 0.0 for stage in TICK_STAGES]
        p99 = [found[stage]["p99"] or 0.0 for stage in TICK_STAGES]
        bars = axes.bar(places, p50, 0.34, label=f"{phase}, median")
        axes.scatter(places, p99, marker="_", s=160, color=bars[0].get_facecolor(), label=f"{phase}, 99 %")
    axes.axhline(1000 / 30, color="grey", linestyle="--", linewidth=1)
    axes.set_yscale("log")
    axes.set_ylabel("ms a tick")
    axes.set_xticks([i + 0.18 for i in range(len(TICK_STAGES))], TICK_STAGES)
    axes.legend(fontsize=8, ncols=2)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=130)
    plt.close(figure)
