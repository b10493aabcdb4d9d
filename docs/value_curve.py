"""Draws docs/value_curve.png from a failed attempt: python docs/value_curve.py recordings/sample/…/attempt_1.mcap"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from far_app.recording.attempt_reader import read_attempt

INK, CURVE, FLAG = "#22303c", "#1f77b4", "#d62728"


def draw(source: Path, target: Path) -> None:
    """V(s_t) over ΔV_t, flagged chunks shaded, with the frame at the start and the end of the worst one."""
    recording = read_attempt(source)
    attempt, lesson = recording.attempt(), recording.adaptation
    if attempt is None or lesson is None:
        sys.exit(f"{source} holds no failed attempt with its adaptation")
    horizon = len(lesson.values) - len(lesson.value_changes)
    worst = int(np.argmin(lesson.value_changes))
    plt.rcParams.update({"font.size": 10, "axes.edgecolor": INK, "axes.spines.top": False, "axes.spines.right": False})
    figure = plt.figure(figsize=(9.6, 4.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(3.4, 1))
    value, change = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    for axis in (value, change):
        for tick in lesson.flagged:
            axis.axvspan(tick, tick + horizon, color=FLAG, alpha=0.12, lw=0)
    value.plot(lesson.values, color=CURVE)
    value.set_ylabel("V(s)")
    value.set_title(f"Attempt {attempt.index}, failed: V(s) and the chunks that were flagged", loc="left")
    change.plot(lesson.value_changes, color=INK, lw=1.2)
    change.axhline(lesson.threshold, color=FLAG, lw=1, ls="--", label=f"lowest 10 %: ΔV ≤ {lesson.threshold:.2f}")
    change.set_ylabel("ΔV of the chunk")
    change.set_xlabel("tick (1/30 s)")
    change.legend(frameon=False, loc="lower right")
    seen = [*(s.observation for s in attempt.steps), attempt.final]
    for row, tick in enumerate((worst, worst + horizon)):
        axis = figure.add_subplot(grid[row, 1])
        axis.imshow(np.hstack([seen[tick].images[c] for c in ("front", "wrist")]))
        axis.set_title(f"tick {tick}", fontsize=9)
        axis.axis("off")
    figure.savefig(target, dpi=150)


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(__file__).with_suffix(".png"))
