"""`far eval`: ways to retry compared on the same scenes, in lockstep with the twin."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from far_app.cli.assemble import assemble, shipped
from far_app.cli.lockstep_twin import lockstep_twin
from far_app.cli.settings import Settings, parse
from far_app.config import RetryConfig
from far_app.errors import RobotError
from far_app.evaluation import (
    DEV_SCENES,
    REPORT_SCENES,
    Arm,
    EvaluationPlan,
    Job,
    evaluate,
    read_arms,
    read_results,
    run_scene,
)
from far_app.protocols import Method, Resume
from far_app.tasks import task as find_task
from far_app.trial import Event
from far_app.types import Trial

log = logging.getLogger(__name__)


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
    out: Path = Path("runs/eval")
    settings: Settings = "model"
    """Begin from what the checkpoint's makers recommend (the retry.toml beside it), or from the paper's settings."""
    retry: RetryConfig = field(default_factory=RetryConfig)


def main(arguments: Sequence[str]) -> int:
    options = parse(EvaluationOptions, arguments, "far eval")
    task = find_task(options.task)
    policy = options.policy or shipped(task.name, "policy")
    critic = options.critic or (
        policy.with_name("critic.safetensors") if options.policy else shipped(task.name, "critic")
    )
    kind = REPORT_SCENES if options.report else DEV_SCENES
    first = kind if options.first_scene is None else options.first_scene
    plan = EvaluationPlan(
        task=task.name, rig=options.rig, policy=str(policy), critic=str(critic),
        arms=read_arms(options.arms)
        if options.arms
        else tuple(Arm(name=m, method=m, retry=options.retry) for m in options.methods),
        first_scene=first, scenes=options.scenes,
        max_attempts=options.attempts,
    )  # fmt: skip
    run_plan(options.out, plan, options.workers)
    print(summary(options.out, plan))
    return 0


def run_plan(folder: Path, plan: EvaluationPlan, workers: int) -> None:
    total = plan.scenes * len(plan.arms)
    with tqdm(total=total, unit="episode") as bar:

        def count(record: dict[str, Any]) -> None:
            bar.update()

        evaluate(folder, plan, workers, count, begin, work)


def summary(folder: Path, plan: EvaluationPlan) -> str:
    """The comparison as Markdown."""
    from far_app.statistics import comparison

    scenes = range(plan.first_scene, plan.first_scene + plan.scenes)
    records = [r for r in read_results(folder / "episodes.jsonl") if r["scene"] in scenes]
    return comparison(records, [a.name for a in plan.arms], plan.max_attempts)


_WORKER: dict[str, Any] = {}


def begin(plan: EvaluationPlan) -> None:
    """Once a worker process: the twin, the networks, the methods; one thread each."""
    import torch

    torch.set_num_threads(1)
    task = dataclasses.replace(find_task(plan.task), max_attempts=plan.max_attempts)
    arms = {a.name: assemble(a.method, task, plan.policy, Path(plan.critic), "cpu", a.retry).method for a in plan.arms}
    _WORKER.update(task=task, robot=lockstep_twin(plan.rig, task), arms=arms)


def work(job: Job) -> list[dict[str, Any]]:
    """One scene under every arm that lacks it."""
    from far_app.detectors import TwinCheck
    from far_app.session.lockstep import adapt_at_once, run_lockstep
    from far_app.session.planners import LockstepPlanner
    from far_app.trial import Adapted, AttemptEnded, trial

    scene, done = job
    robot, task = _WORKER["robot"], _WORKER["task"]

    def run(method: Method, seed: int) -> Trial:
        events = trial(
            seed, robot, LockstepPlanner(), method, TwinCheck(task.success_ticks), task, robot.rig.scale, adapt_at_once
        )
        heard: list[Event] = []
        try:
            return run_lockstep(events, robot.advance, heard.append)
        except RobotError as error:  # the arm latched (it could not get home, say): the trial ends as it stands
            log.warning("scene %d, %s: %s", seed, method.name, error)
            robot.request(Resume())
            attempts = tuple(e.attempt for e in heard if isinstance(e, AttemptEnded))
            adaptations = tuple(e.adaptation for e in heard if isinstance(e, Adapted))
            return Trial(scene_seed=seed, attempts=attempts, adaptations=adaptations)

    return list(run_scene(scene, _WORKER["arms"], done, run))
