"""`far trials PLAN.toml`: methods × scenes × repetitions in a random order, compared as they come; goes on where it was
interrupted."""

from __future__ import annotations

import dataclasses
import functools
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from far_app.cli.assemble import Parts, assemble, equip, load_model
from far_app.cli.options import RunOptions
from far_app.cli.run import Ending, on_this_robot, supervise
from far_app.cli.settings import recommended
from far_app.cli.stage import Stage, stage
from far_app.config import RetryConfig, TaskConfig, from_table
from far_app.recording.reader import SessionRecording
from far_app.session.statistics import LoopStatistics
from far_app.trial_plan.course import Equipped, PlanCourse
from far_app.trial_plan.order import slots
from far_app.trial_plan.plan import PlannedMethod, TrialPlan
from far_app.trial_plan.progress import done_in, sessions_of
from far_app.trial_plan.read import read_plan
from far_app.trial_plan.scene_gate import References
from far_app.trial_plan.shown import PlanShown
from far_app.trial_plan.telling import Teller, lines

if TYPE_CHECKING:
    from far_app.learning.apart.protocol import Work

Ours = tyro.conf.Suppress
"""The plan says it, not the command line."""


@dataclass(frozen=True, kw_only=True)
class TrialsOptions(RunOptions):
    """Run a plan of trials; the same command goes on where it was interrupted. docs/trials.md has the plan's keys."""

    plan: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="PLAN.toml")]]
    show: bool = False
    """Only tell how far the plan is and what it says so far."""
    trials: Ours[int] = 0
    seed: Ours[int] = 0
    method: Ours[str] = "far"
    task: Ours[str] = "lift"
    policy: Ours[str | None] = None
    critic: Ours[Path | None] = None
    max_attempts: Ours[int | None] = None
    settings: Ours[Literal["model", "paper"]] = "model"
    retry: Ours[RetryConfig] = dataclasses.field(default_factory=RetryConfig)
    shadow: Ours[bool] = False
    summary_json: Ours[Path | None] = None


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(TrialsOptions, args=list(arguments), prog="far trials")
    logging.basicConfig(
        level=logging.INFO if options.verbose else logging.WARNING,
        format="%(asctime)s %(levelname)s %(name)s: %(message)s",
    )
    plan, options = planned(options)
    earlier = sessions_of(plan, options.recordings)
    references = References(plan, earlier)
    left = plan.trials - sum(slot in done_in(earlier) for slot in slots(plan))
    if options.show or not left:
        tell(teller(plan, options).shown(done_in(earlier)))
        return 0
    run(plan, dataclasses.replace(options, trials=left), earlier, references)
    return 0


def planned(options: TrialsOptions) -> tuple[TrialPlan, TrialsOptions]:
    """The plan, checked against this robot; and the options as it has them. Raises ConfigError before anything
    starts."""
    from far_app.methods import METHODS
    from hw.camera_config import views_of

    rig = options.load_rig()
    cameras = tuple(views_of(rig.cameras)) if rig.cameras else ()
    plan = read_plan(options.plan, robot=rig.robot, cameras=cameras, methods=tuple(METHODS))
    options = dataclasses.replace(
        options, task=plan.task, max_attempts=plan.max_attempts, rerun=options.rerun and not plan.blind
    )
    found = [
        settings(plan, method, options, f"{plan.file}: method[{number}].retry")
        for number, method in enumerate(plan.methods, 1)
    ]
    learning = next((i for i, m in enumerate(plan.methods) if METHODS[m.method].needs_critic), 0)
    return plan, dataclasses.replace(options, retry=found[learning])  # what-if on the recording begins from these


def settings(plan: TrialPlan, method: PlannedMethod, options: RunOptions, where: str) -> RetryConfig:
    """Of one method: its checkpoint's or the paper's, as this robot has them, and what the plan says over that."""
    chosen = RetryConfig() if method.settings == "paper" else recommended(plan.task, method.policy)
    return from_table(RetryConfig, method.retry, where, on_this_robot(options, chosen))


def attempts(parts: Parts, options: RunOptions, task: TaskConfig) -> int:
    """A trial's: where the method fixes them, that many."""
    return parts.max_attempts or options.max_attempts or task.max_attempts


def assembled(
    plan: TrialPlan, options: RunOptions, task: TaskConfig, work: Callable[[], Work]
) -> Mapping[str, Parts]:  # fmt: skip
    """Every method of the plan; a model that several share is loaded once. Raises ConfigError and CheckpointError."""
    parts: dict[str, Parts] = {}
    models = {}
    for method in plan.methods:
        key = (method.policy, method.critic)
        retry = settings(plan, method, options, f"{plan.file}: method '{method.name}'.retry")
        if method.policy is not None and method.policy.startswith("test:"):
            parts[method.name] = assemble(method.method, task, method.policy, None, options.device, retry)
            continue
        if key not in models:
            sharing = [m.method for m in plan.methods if (m.policy, m.critic) == key]
            models[key] = load_model(
                *key, task.name, options.device, sharing, options.engine, threads=options.torch_threads
            )
        parts[method.name] = equip(models[key], method.method, retry, work)
    return parts


def run(plan: TrialPlan, options: TrialsOptions, earlier: Sequence[SessionRecording], references: References) -> None:
    """What is left of the plan, as one session. Raises the FarError that ended it."""
    with Ending() as ending, stage(options, functools.partial(assembled, plan)) as stage_:
        writer = stage_.writer(plan)
        course = PlanCourse(
            plan, equipped(stage_), earlier=earlier, folder=writer.folder, references=references, tell=tell
        )
        tell(course.shown())
        supervise(stage_, writer, ending, LoopStatistics(), course)
        shown = course.shown()
    if shown.done == shown.total:
        sessions = " ".join(str(path) for path in (*(session.path for session in earlier), writer.folder))
        print(f"The plan is done; its page: far report {sessions}", flush=True)
    else:
        print(f"{shown.total - shown.done} trials are left; the same command goes on", flush=True)


def equipped(stage_: Stage) -> dict[str, Equipped]:
    return {
        name: Equipped(
            method=parts.method, max_attempts=attempts(parts, stage_.options, stage_.task), policy=parts.policy_name
        )
        for name, parts in stage_.methods.items()
    }


def teller(plan: TrialPlan, options: RunOptions) -> Teller:
    """Without loading anything."""
    from far_app.methods import METHODS
    from far_app.tasks import supervised
    from far_app.tasks import task as find_task

    task = find_task(plan.task)
    usual = options.max_attempts or (task if plan.robot == "twin" else supervised(task)).max_attempts
    return Teller(plan=plan, attempts={m.name: METHODS[m.method].attempts or usual for m in plan.methods})


def tell(shown: PlanShown) -> None:
    print("\n".join(lines(shown)), flush=True)
