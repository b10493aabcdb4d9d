"""Success by attempt as a picture, one panel a task, with Wilson's intervals. Called by far_app/cli/report.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from far_app.report import Results, together
from far_app.statistics import wilson

DODGE = 0.06
"""Attempts by which neighbouring methods stand apart, so that their intervals can be told from each other."""


def draw(results: Results, target: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    tasks = [t for t in results.tasks if results.clusters(t)]
    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure, axes = plt.subplots(
        1, len(tasks), figsize=(1.6 + 4.4 * len(tasks), 4.2), sharey=True, squeeze=False, layout="constrained"
    )
    attempts = np.arange(1, results.max_attempts + 1)
    for axis, task in zip(axes[0], tasks, strict=True):
        clusters = results.clusters(task)
        for number, arm in enumerate(results.arms):
            counts = [together(results, clusters, arm, int(k)) for k in attempts]
            rates = np.array([np.mean(c) for c in counts])
            bounds = np.array([wilson(sum(c), len(c)) for c in counts]).T
            at = attempts + DODGE * (number - (len(results.arms) - 1) / 2)
            axis.errorbar(
                at, 100 * rates, yerr=100 * np.abs(bounds - rates), color=f"C{number}", marker="o", ms=4, lw=1.6,
                elinewidth=0.7, label=arm,
            )  # fmt: skip
        episodes = len(together(results, clusters, results.arms[0], 1))
        axis.set_title(f"{task}: {episodes} episodes, {len(clusters)} model{'s' * (len(clusters) > 1)}", loc="left")
        axis.set_xlabel("within so many attempts")
        axis.set_xticks(attempts)
        axis.set_ylim(0, 103)
        axis.grid(axis="y", alpha=0.25)
    axes[0][0].set_ylabel("success, per cent (95 % Wilson)")
    axes[0][-1].legend(frameon=False, loc="lower right")
    figure.savefig(target, dpi=130)
    plt.close(figure)
