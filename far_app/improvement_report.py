"""What runs of continual improvement say, side by side: success of the policy alone against episodes (each is one reset
of the scene) and against policy ticks, by collector. Called by far_app/cli/report.py.

Every evaluation of a run is on the same scenes, so that an epoch is compared with the policy it began from, and one
collector's last policy with another's, scene by scene.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from far_app.errors import ConfigError
from far_app.evaluation import read_results
from far_app.improvement import Epoch, read_log
from far_app.report import BASELINE, paired, rate
from far_app.statistics import wilson


@dataclass(frozen=True, kw_only=True)
class Run:
    """One folder of `far improve`."""

    task: str
    collector: str
    reward: str
    seed: int
    epochs: Mapping[int, Epoch]
    """Those after which the policy was evaluated, by number; 0 is before the first."""
    solved: Mapping[int, Mapping[int, bool]]
    """By epoch and scene."""


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One collector's runs (training seeds) on a task, as far as all of them are."""

    task: str
    collector: str
    reward: str
    runs: tuple[Run, ...]

    @property
    def name(self) -> str:
        return self.collector if self.reward == "shaped" else f"{self.collector}, {self.reward} reward"

    @property
    def epochs(self) -> list[int]:
        return sorted(set.intersection(*(set(run.epochs) for run in self.runs)))

    def mean(self, epoch: int, what: str) -> float:
        """Of a count in the log ("episodes", "timesteps")."""
        return float(np.mean([getattr(run.epochs[epoch], what) for run in self.runs]))

    def outcomes(self, epoch: int) -> dict[tuple[int, int], bool]:
        """Success by (seed, scene)."""
        return {(run.seed, scene): won for run in self.runs for scene, won in run.solved[epoch].items()}


def is_improvement(folder: Path) -> bool:
    """Whether `far improve` wrote it."""
    plan = folder / "plan.json"
    return plan.exists() and "collector" in json.loads(plan.read_text())


def improvements_in(folder: Path) -> list[Path]:
    """The folder itself, or those directly below it."""
    return (
        [folder]
        if is_improvement(folder)
        else sorted(f.parent for f in folder.glob("*/plan.json") if is_improvement(f.parent))
    )


def read_run(folder: Path) -> Run:
    """Raises ConfigError when nothing was evaluated yet."""
    plan = json.loads((folder / "plan.json").read_text())
    epochs = {e.epoch: e for e in read_log(folder / "log.jsonl") if e.evaluation is not None}
    if not epochs:
        raise ConfigError(f"{folder} has no evaluation yet; let far improve go on")
    records = {n: read_results(folder / f"epoch-{n:02d}" / "evaluation" / "episodes.jsonl") for n in epochs}
    return Run(
        task=plan["task"], collector=plan["collector"], reward=plan["loop"]["reward"], seed=plan["loop"]["seed"],
        epochs=epochs, solved={n: {int(r["scene"]): bool(r["success"]) for r in found} for n, found in records.items()},
    )  # fmt: skip


def curves(folders: Sequence[Path]) -> list[Curve]:
    """Everything in these folders, by task, in the order of ORDER. Raises ConfigError."""
    runs: dict[tuple[str, str, str], list[Run]] = {}
    for run in (read_run(path) for folder in folders for path in improvements_in(folder)):
        runs.setdefault((run.task, run.reward, run.collector), []).append(run)
    names = sorted(runs, key=lambda name: (*name[:2], ORDER.index(name[2])))
    return [Curve(task=t, collector=c, reward=r, runs=tuple(runs[t, r, c])) for t, r, c in names]


ORDER = ("dp", "nr", "far")


def markdown(found: Sequence[Curve]) -> str:
    tasks = list(dict.fromkeys(c.task for c in found))
    return "\n\n".join(["# Continual improvement", *(section([c for c in found if c.task == t]) for t in tasks)]) + "\n"


def section(found: Sequence[Curve]) -> str:
    """One task's table, and its collectors against naive retry."""
    seeds = len(found[0].runs)
    lines = [
        f"## {found[0].task}", "",
        f"Success of the policy alone, without retry or noise, {seeds} run{'s' * (seeds > 1)} a collector; 95 % "
        "intervals; differences are paired scene by scene.", "",
        "| collector | epoch | episodes (resets) | policy ticks | success, per cent | − before, points |",
        "|---|---|---|---|---|---|",
    ]  # fmt: skip
    for curve in found:
        for epoch in curve.epochs:
            before = difference(curve.outcomes(epoch), curve.outcomes(0)) if epoch and 0 in curve.epochs else ""
            spent = " | ".join(f"{curve.mean(epoch, what):.0f}" for what in ("episodes", "timesteps"))
            lines.append(f"| {curve.name} | {epoch} | {spent} | {rate([*curve.outcomes(epoch).values()])} | {before} |")
    for curve in found:
        for other in found:
            shared = set(curve.epochs) & set(other.epochs) - {0}
            if shared and other.collector == BASELINE and curve.reward == other.reward and curve is not other:
                last = max(shared)
                lines += ["", f"{curve.name} − {other.name} after {last} epochs: "
                          f"{difference(curve.outcomes(last), other.outcomes(last))}."]  # fmt: skip
    return "\n".join(lines)


def difference(ours: Mapping[tuple[int, int], bool], theirs: Mapping[tuple[int, int], bool]) -> str:
    """On the scenes of both."""
    scenes = sorted(ours.keys() & theirs.keys())
    if not scenes:
        return "no scene in common"
    points, p = paired([ours[s] for s in scenes], [theirs[s] for s in scenes])
    return f"{points}, p = {p}"


def draw(found: Sequence[Curve], target: Path) -> None:
    """A row a task: success against episodes, and against policy ticks."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    tasks = list(dict.fromkeys(c.task for c in found))
    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure, axes = plt.subplots(
        len(tasks), 2, figsize=(10.4, 0.6 + 3.6 * len(tasks)), sharey=True, squeeze=False, layout="constrained"
    )
    for row, task in zip(axes, tasks, strict=True):
        for axis, what, label in zip(
            row, ("episodes", "timesteps"), ("episodes (resets)", "policy ticks"), strict=True
        ):
            for number, curve in enumerate(c for c in found if c.task == task):
                rates = np.array([np.mean(list(curve.outcomes(e).values())) for e in curve.epochs])
                bounds = np.array([
                    wilson(sum(o.values()), len(o)) for o in (curve.outcomes(e) for e in curve.epochs)
                ]).T  # fmt: skip
                axis.errorbar(
                    [curve.mean(e, what) for e in curve.epochs], 100 * rates, yerr=100 * np.abs(bounds - rates),
                    color=f"C{number}", marker="o", ms=4, lw=1.6, elinewidth=0.7, label=curve.name,
                )  # fmt: skip
            axis.set_xlabel(label)
            axis.set_ylim(0, 103)
            axis.grid(axis="y", alpha=0.25)
        row[0].set_title(task, loc="left")
        row[0].set_ylabel("success, per cent (95 % Wilson)")
    axes[0][0].legend(frameon=False, loc="lower right")
    figure.savefig(target, dpi=130)
    plt.close(figure)
