"""`far eval`: ways to retry compared on the same scenes, in lockstep with the twin."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from tqdm import tqdm

from far_app.cli.assemble import check_methods, checkpoints, equip, load_model
from far_app.cli.lockstep_twin import LANES, lockstep_twins, side_by_side
from far_app.cli.settings import Settings, parse
from far_app.config import RetryConfig
from far_app.errors import ConfigError
from far_app.evaluation import (
    DEV_SCENES,
    REPORT_SCENES,
    Arm,
    Episode,
    EvaluationPlan,
    evaluate,
    read_arms_file,
    read_results,
    run_scenes,
)
from far_app.ray_workers import ray_workers
from far_app.tasks import task as find_task
from far_app.types import Trial
from far_app.workers import Job, Workers, local_workers
from hw.rig import load_rig


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions:
    """Run every method on the same scenes; a second start goes on where the first one stopped."""

    task: str = "lift"
    methods: tuple[str, ...] = ("nr", "perturb", "far")
    arms: Path | None = None
    """A TOML file of [[arm]] tables (name, method, settings that differ), instead of methods."""
    scenes: int = 200
    first_scene: int | None = None
    """Where the scenes begin; 20,000 by default, 30,000 with --report."""
    report: bool = False
    """Use the reporting scenes; without it the scenes kept for choices."""
    attempts: int = 5
    policy: Path | None = None
    """The shipped quickstart model by default."""
    critic: Path | None = None
    rig: str = "twin"
    workers: int = 2
    engine: Literal["local", "ray"] = "local"
    """Workers as processes of this machine, or on a Ray cluster."""
    address: str | None = None
    """With --engine ray: the cluster's address (an own one on this machine otherwise)."""
    out: Path = Path("runs/eval")
    settings: Settings = "model"
    """Begin from what the checkpoint's makers recommend (the retry.toml beside it), or from the paper's settings."""
    retry: RetryConfig = field(default_factory=RetryConfig)


def main(arguments: Sequence[str]) -> int:
    options = parse(EvaluationOptions, arguments, "far eval")
    task = find_task(options.task, load_rig(options.rig).arm)
    policy, critic = checkpoints(task.name, options.policy, options.critic)
    kind = REPORT_SCENES if options.report else DEV_SCENES
    first = kind if options.first_scene is None else options.first_scene
    plan = EvaluationPlan(
        task=task.name, rig=options.rig, policy=str(policy), critic=str(critic),
        arms=read_arms_file(options.arms)
        if options.arms
        else tuple(Arm(name=m, method=m, retry=options.retry) for m in options.methods),
        first_scene=first, scenes=options.scenes,
        max_attempts=options.attempts,
    )  # fmt: skip
    check_methods([arm.method for arm in plan.arms])
    if options.address is not None and options.engine != "ray":
        raise ConfigError(f"--address {options.address} was given without --engine ray")
    run = ray_workers(options.address) if options.engine == "ray" else local_workers
    run_plan(options.out, plan, options.workers, run)
    print(summary(options.out, plan))
    return 0


def run_plan(folder: Path, plan: EvaluationPlan, workers: int, run: Workers = local_workers) -> None:
    """What is missing, with a progress bar; says how fast it went."""
    began, ticks = time.monotonic(), 0
    with tqdm(total=plan.scenes * len(plan.arms), unit="episode") as bar:

        def count(record: dict[str, Any]) -> None:
            nonlocal ticks
            bar.update()
            ticks += 0 if record.get("shared") else sum(record["ticks"])

        evaluate(folder, plan, workers, count, begin, work, run)
    seconds = time.monotonic() - began
    if ticks:
        print(f"{ticks} policy ticks in {seconds:.0f} s: {ticks / seconds:.0f} a second, workers: {workers}\n")


def summary(folder: Path, plan: EvaluationPlan) -> str:
    """The comparison as Markdown."""
    from far_app.statistics import comparison

    scenes = range(plan.first_scene, plan.first_scene + plan.scenes)
    records = [r for r in read_results(folder / "episodes.jsonl") if r["scene"] in scenes]
    return comparison(records, [a.name for a in plan.arms], plan.max_attempts)


_WORKER: dict[str, Any] = {}


def begin(plan: EvaluationPlan) -> None:
    """Once a worker process: twins, networks, methods; one thread each."""
    import torch

    torch.set_num_threads(1)
    rig = load_rig(plan.rig)
    task = dataclasses.replace(find_task(plan.task, rig.arm), max_attempts=plan.max_attempts)
    model = load_model(
        plan.policy, Path(plan.critic), task.name, "cpu", [a.method for a in plan.arms], lanes=LANES
    )  # fmt: skip
    parts = {a.name: equip(model, a.method, a.retry) for a in plan.arms}
    images = any(p.method.policy.spec.cameras for p in parts.values())
    robots = lockstep_twins(plan.rig, task, min(LANES, plan.scenes), images)
    methods = {name: [p.another() for _ in robots] for name, p in parts.items()}
    attempts = {name: p.max_attempts for name, p in parts.items()}
    _WORKER.update(task=task, robots=robots, methods=methods, attempts=attempts)


def work(jobs: Iterable[Job]) -> Iterator[dict[str, Any]]:
    """The missing records of scenes."""
    yield from run_scenes(jobs, list(_WORKER["methods"]), run_episodes)


def run_episodes(take: Callable[[], Episode | None]) -> Iterator[tuple[Episode, Trial]]:
    """Trials of scenes under arms, side by side on this worker's twins."""
    methods, attempts = _WORKER["methods"], _WORKER["attempts"]
    return side_by_side(
        take, _WORKER["robots"], lambda episode, lane: (episode[1], methods[episode[0]][lane]), _WORKER["task"],
        attempts=lambda episode: attempts[episode[0]],
    )  # fmt: skip
