"""The twin in this process on a simulated clock, as demonstrations, evaluations and benchmarks want it; and trials of
scenes on several of them."""

from __future__ import annotations

import dataclasses
import logging
import os
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, TypeVar

from far_app.config import TaskConfig
from far_app.errors import RobotError
from far_app.protocols import Method, Resume
from far_app.types import Trial
from hw.lockstep import LockstepRobot
from hw.rig import RigConfig, load_rig
from hw.setup import setup_of

if TYPE_CHECKING:
    from far_app.alarm import Alarm
    from far_app.session.lockstep import Take

J = TypeVar("J", bound=Hashable)
log = logging.getLogger(__name__)

LANES = 8
"""Trials side by side: a chunk in a batch of eight costs a fraction of one alone."""


def lockstep_twin(rig_name: str, task: TaskConfig, images: bool = True) -> LockstepRobot:
    """One twin, with a view of its own where images are wanted."""
    return lockstep_twins(rig_name, task, 1, images)[0]


def lockstep_twins(rig_name: str, task: TaskConfig, count: int, images: bool = True) -> list[LockstepRobot]:
    """Several twins of one scene that share a view; the software renderer stays on one thread, so that processes
    scale over cores."""
    os.environ.setdefault("LP_NUM_THREADS", "1")
    from hw.twin import TwinPlant
    from hw.twin_view import TwinView

    rig = load_rig(rig_name, task.name)
    plants = [TwinPlant(rig, task) for _ in range(count)]
    view = TwinView(plants[0].model_xml(), plants[0].base_pose(), plants[0].cameras()) if images else None
    return [LockstepRobot(plant, view, rig, task) for plant in plants]


def origin(task: TaskConfig, rig: RigConfig) -> dict[str, object]:
    """Where a dataset's episodes come from, as robomimic's env_args; `setup` is ours (far_app/preflight.py)."""
    return {
        "env_name": task.environment, "type": 1,
        "env_kwargs": {"robots": rig.arm, "rig": dataclasses.asdict(rig)}, "setup": setup_of(rig, task).table(),
    }  # fmt: skip


def trials(
    scenes: Iterable[int],
    robots: Sequence[LockstepRobot],
    methods: Sequence[Method],
    task: TaskConfig,
    alarms: Sequence[Alarm] = (),
) -> Iterator[tuple[int, Trial]]:
    """A trial of each scene, as many side by side as there are robots, each as it ends; a method for each robot."""
    waiting = iter(scenes)
    return side_by_side(
        lambda: next(waiting, None), robots, lambda scene, lane: (scene, methods[lane]), task, alarms
    )  # fmt: skip


def side_by_side(
    take: Take[J],
    robots: Sequence[LockstepRobot],
    cast: Callable[[J, int], tuple[int, Method]],
    task: TaskConfig,
    alarms: Sequence[Alarm] = (),
    attempts: Callable[[J], int | None] = lambda job: None,
) -> Iterator[tuple[J, Trial]]:
    """Trials of whatever `take` hands out; `cast` names the scene of a job and its method on a lane; an alarm for each
    robot, or none; `attempts` of a job's trial where they are not the task's."""
    from far_app.attempt import NO_ALARM, Setting
    from far_app.detectors import TwinCheck
    from far_app.session.lockstep import Lane, adapt_at_once, run_together
    from far_app.session.planners import LockstepPlanner
    from far_app.trial import trial

    def start(job: J, lane: int) -> Lane:
        robot = robots[lane]
        robot.request(Resume())
        scene, method = cast(job, lane)
        setting = Setting(
            robot=robot, planner=LockstepPlanner(), detector=TwinCheck(task.success_ticks),
            task=dataclasses.replace(task, max_attempts=attempts(job) or task.max_attempts),
            scale=robot.scale, alarm=alarms[lane] if alarms else NO_ALARM,
        )  # fmt: skip
        return Lane(trial(scene, method, setting, adapt_at_once), robot.advance, robot.free)

    def failed(job: J, lane: Lane, error: RobotError) -> Trial:
        """The arm latched too often: the trial ends as it stands."""
        scene, method = cast(job, 0)
        log.warning("scene %d, %s: %s", scene, method.name, error)
        return Trial(
            scene_seed=scene, attempts=tuple(lane.attempts), adaptations=tuple(lane.adaptations), rescues=lane.rescues
        )

    return run_together(take, len(robots), start, failed)
