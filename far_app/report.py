"""What results say, as Markdown: success by attempt, paired differences from the same scenes, tests, costs.

Per task: success over its training seeds (mean ± standard deviation), Wilson's 95 % interval over episodes, the exact
McNemar p against naive retry. Over tasks: the mean difference, with an interval from resampled (task, training seed)
clusters, because episodes of one model are not independent of each other, and from resampled scenes of each, because a
task with a single model would otherwise count as known exactly.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from far_app.errors import ConfigError
from far_app.evaluation import read_results
from far_app.paper import PAPER
from far_app.statistics import costs, mcnemar, paired_difference, solved_within, wilson

RESAMPLES = 10_000
BASELINE = "nr"

Cluster = tuple[str, str]
"""A task and a model of it (a training seed)."""
Records = Sequence[Mapping[str, Any]]


@dataclass(frozen=True, kw_only=True)
class Results:
    arms: tuple[str, ...]
    max_attempts: int
    records: Mapping[Cluster, Records]

    @property
    def tasks(self) -> list[str]:
        return list(dict.fromkeys(task for task, _ in self.records))

    def solved(self, cluster: Cluster, arm: str, attempts: int) -> dict[int, bool]:
        """By scene, of those that every arm has run."""
        by_arm = {a: {r["scene"]: r for r in self.records[cluster] if r["arm"] == a} for a in self.arms}
        scenes = sorted(set.intersection(*(set(found) for found in by_arm.values())))
        return {s: solved_within(dict(by_arm[arm][s]), attempts) for s in scenes}

    def clusters(self, task: str) -> list[Cluster]:
        return [c for c in self.records if c[0] == task and self.solved(c, self.arms[0], 1)]


def read_folder(folder: Path) -> Results:
    """Everything in a folder of `far eval`, or in one with a folder for each model (`far study`). Raises ConfigError
    when there is nothing, or when two of them compare different things."""
    plans = sorted(folder.glob("plan.json")) or sorted(folder.glob("*/plan.json"))
    if not plans:
        raise ConfigError(
            f"no results in {folder} (no plan.json there or one folder below); give the --out of far eval"
        )
    records: dict[Cluster, Records] = {}
    compared: tuple[list[dict[str, Any]], int] | None = None
    for path in plans:
        plan = json.loads(path.read_text())
        here = (plan["arms"], plan["max_attempts"])
        if compared not in (None, here):
            raise ConfigError(f"{path.parent} compares other methods or settings than {plans[0].parent}; report each")
        compared = here
        records[plan["task"], path.parent.name] = read_results(path.with_name("episodes.jsonl"))
    assert compared is not None
    arms, max_attempts = compared
    return Results(arms=tuple(a["name"] for a in arms), max_attempts=max_attempts, records=records)


def read_folders(folders: Sequence[Path]) -> Results:
    """Several folders side by side: other tasks, or other models of the same, under the arms that all of them have, by
    name (their settings may differ, as tasks do). Raises ConfigError where they cannot be put side by side."""
    found = [read_folder(folder) for folder in folders]
    arms = tuple(a for a in found[0].arms if all(a in other.arms for other in found))
    if not arms:
        raise ConfigError(f"{' and '.join(map(str, folders))} have no arm of the same name")
    if len({results.max_attempts for results in found}) > 1:
        counts = ", ".join(f"{folder} {results.max_attempts}" for folder, results in zip(folders, found, strict=True))
        raise ConfigError(f"the results allow different numbers of attempts: {counts}; report each")
    records: dict[Cluster, Records] = {}
    for folder, results in zip(folders, found, strict=True):
        if twice := set(records) & set(results.records):
            raise ConfigError(f"{folder} holds {' '.join(min(twice))} again, which another of the folders has")
        records |= results.records
    return Results(arms=arms, max_attempts=found[0].max_attempts, records=records)


def markdown(results: Results) -> str:
    parts = [task_section(results, task) for task in results.tasks if results.clusters(task)]
    if len(parts) > 1:
        parts.append(pooled_section(results))
    return "\n\n".join(["# Results", *parts]) + "\n"


def task_section(results: Results, task: str) -> str:
    """One task's tables."""
    clusters, last = results.clusters(task), results.max_attempts
    episodes = sum(len(results.solved(c, results.arms[0], 1)) for c in clusters)
    lines = [
        f"## {task}", "",
        f"{episodes} episodes of {len(clusters)} training seed{'s' * (len(clusters) > 1)}, up to {last} attempts.", "",
        "| method | attempt 1 | " + " | ".join(f"within {k}" for k in range(2, last + 1))
        + f" | mean ± std over seeds | − {BASELINE}, points | McNemar p |",
        "|---" * (last + 4) + "|",
    ]  # fmt: skip
    for arm in results.arms:
        cells = [arm]
        for attempts in range(1, last + 1):
            solved = together(results, clusters, arm, attempts)
            cells.append(rate(solved) if attempts in (1, last) else f"{100 * np.mean(solved):.1f}")
        by_seed = [100 * float(np.mean(list(results.solved(c, arm, last).values()))) for c in clusters]
        spread = f" ± {np.std(by_seed, ddof=1):.1f}" if len(by_seed) > 1 else ""
        cells.append(f"{np.mean(by_seed):.1f}{spread}")
        cells += ["", ""] if arm == BASELINE or BASELINE not in results.arms else against(results, clusters, arm)
        lines.append("| " + " | ".join(cells) + " |")
    lines += [
        "",
        "| cost of an episode | attempts (resets) | policy ticks | adaptations | seconds an adaptation |",
        "|---|---|---|---|---|",
    ]
    for arm in results.arms:
        records = [dict(r) for c in clusters for r in results.records[c] if r["arm"] == arm]
        lines.append(f"| {arm} | {' | '.join(costs(records))} |")
    for paper in PAPER.get(task, ()):
        lines += [
            "",
            f"The paper's, {paper.demonstrations} demonstrations, within 5: dp {paper.dp}, nr {paper.nr}, "
            f"bgr {paper.bgr}, far {paper.far}.",
        ]
    return "\n".join(lines)


def pooled_section(results: Results) -> str:
    """The mean over tasks, and its differences with intervals from resampled clusters and scenes."""
    lines = [
        "## over tasks", "",
        f"Success within {results.max_attempts}, mean over tasks; differences in points with 95 % intervals from "
        f"{RESAMPLES:,} resamples of (task, training seed) clusters and of each one's scenes.", "",
        f"| method | success | − {BASELINE} | − first attempt (dp) |", "|---|---|---|---|",
    ]  # fmt: skip
    for arm in results.arms:
        mean = np.mean([np.mean(together(results, results.clusters(t), arm, results.max_attempts))
                        for t in results.tasks if results.clusters(t)])  # fmt: skip
        versus = "" if arm == BASELINE or BASELINE not in results.arms else pooled(results, arm, BASELINE)
        lines.append(f"| {arm} | {100 * mean:.1f} | {versus} | {pooled(results, arm, None)} |")
    return "\n".join(lines)


def together(results: Results, clusters: Sequence[Cluster], arm: str, attempts: int) -> list[bool]:
    return [solved for c in clusters for solved in results.solved(c, arm, attempts).values()]


def rate(solved: Sequence[bool]) -> str:
    low, high = wilson(sum(solved), len(solved))
    return f"{100 * np.mean(solved):.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def against(results: Results, clusters: Sequence[Cluster], arm: str) -> list[str]:
    """Paired difference to the baseline, and its exact p."""
    ours, theirs = (together(results, clusters, a, results.max_attempts) for a in (arm, BASELINE))
    return [*paired(ours, theirs)]


def paired(ours: Sequence[bool], theirs: Sequence[bool]) -> tuple[str, str]:
    """The difference on the same scenes, in points with its interval, and the exact McNemar p."""
    mean, low, high = paired_difference(ours, theirs)
    p = mcnemar(
        sum(a and not b for a, b in zip(ours, theirs, strict=True)),
        sum(b and not a for a, b in zip(ours, theirs, strict=True)),
    )
    return f"{100 * mean:+.1f} [{100 * low:+.1f}, {100 * high:+.1f}]", f"{p:.3g}"


def pooled(results: Results, arm: str, baseline: str | None) -> str:
    """Mean over tasks of the paired difference to a baseline, or to the first attempt; clusters are resampled within
    their tasks, scenes within their clusters."""
    by_task: list[list[Float[np.ndarray, "N"]]] = []
    for task in results.tasks:
        differences = []
        for cluster in results.clusters(task):
            ours = results.solved(cluster, arm, results.max_attempts)
            theirs = results.solved(cluster, baseline or arm, results.max_attempts if baseline else 1)
            differences.append(np.array([float(ours[s]) - float(theirs[s]) for s in ours]))
        if differences:
            by_task.append(differences)
    rng = np.random.default_rng(0)
    draws = np.mean([resampled(differences, rng) for differences in by_task], axis=0)
    low, high = np.percentile(draws, (2.5, 97.5))
    mean = np.mean([np.mean([d.mean() for d in differences]) for differences in by_task])
    return f"{100 * mean:+.1f} [{100 * low:+.1f}, {100 * high:+.1f}]"


def resampled(clusters: Sequence[Float[np.ndarray, "N"]], rng: np.random.Generator) -> Float[np.ndarray, "R"]:
    """Means of a task's differences, each from as many clusters drawn with replacement, and of each as many scenes."""
    slots = (RESAMPLES, len(clusters))
    means = np.stack([_redrawn(differences, rng, slots) for differences in clusters], axis=-1)
    drawn = rng.integers(0, len(clusters), slots)
    return np.take_along_axis(means, drawn[..., None], axis=-1)[..., 0].mean(axis=1)


def _redrawn(
    differences: Float[np.ndarray, "N"], rng: np.random.Generator, shape: tuple[int, ...]
) -> Float[np.ndarray, "*S"]:
    """The mean of N scenes drawn with replacement, so many times."""
    values, counts = np.unique(differences, return_counts=True)
    count = len(differences)
    return rng.multinomial(count, counts / count, shape) @ values / count
