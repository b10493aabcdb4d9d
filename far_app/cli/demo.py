"""`far demo`: demonstrations by the scripted expert, in lockstep with the twin, appended to an HDF5 file; by a person
with --teleop or --by-hand (demo_person.py).

With --policy it records a policy's own attempts instead, whatever their outcome: what a critic learns failure from.
"""

from __future__ import annotations

import dataclasses
import itertools
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from tqdm import tqdm

from far_app.cli.lockstep_twin import LANES, lockstep_twins, origin, trials
from far_app.config import TaskConfig
from far_app.demonstrations import SEED_OFFSET, demonstrate
from far_app.errors import ConfigError
from far_app.learning.dataset import check_origin, count_episodes, episode_of, last_scene, seen_and_done, write_episode
from far_app.tasks import task as find_task
from far_app.types import Observation
from hw.lockstep import LockstepRobot
from hw.rig import load_rig

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class DemoOptions:
    """Make demonstrations; a second start goes on where the first one stopped."""

    task: str = "lift"
    n: int = 100
    """Successful demonstrations to have in the file at the end."""
    seed: int = 0
    """Demonstration scenes are numbered from here; they never coincide with reporting scenes."""
    out: Path | None = None
    """HDF5 file; datasets/TASK.hdf5 by default, datasets/TASK.person.hdf5 for a person's."""
    policy: Path | None = None
    """Record this policy's attempts instead of the expert's demonstrations."""
    explore: float = 0.0
    """With --policy: standard deviation of smoothed perturbations of the translation, in action units. A critic learns
    from them what other actions would have led to."""
    linger: int = 0
    """Ticks to go on after a success: a success detector learns from them what success looks like."""
    teleop: bool = False
    """You demonstrate: steer the arm from the page, or with the SpaceMouse or gamepad of the rig."""
    by_hand: bool = False
    """You demonstrate: lead a real xArm7 with your hands."""
    robot: Literal["twin", "xarm"] | None = None
    """With --teleop or --by-hand: which arm; the rig file's own when it is not given."""
    host: str = ""
    """ADDRESS[:PORT] of a real arm's controller."""
    port: int = 8080
    """The page's, for --teleop and --by-hand."""
    recordings: Path = Path("recordings")
    """All that you demonstrate is recorded here as a session, kept or not."""
    rig: str | None = None
    """The twin by default; xarm7 with --robot xarm."""
    images: bool = True
    """Draw the cameras; a policy of the `state` preset needs none."""


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(DemoOptions, args=list(arguments), prog="far demo")
    if options.teleop or options.by_hand:
        return by_a_person(options)
    name = options.rig or "twin"
    rig = load_rig(name, options.task)
    task = find_task(options.task, rig.arm)
    task = dataclasses.replace(task, success_ticks=task.success_ticks + options.linger)
    path = options.out or Path("datasets") / f"{task.name}.hdf5"
    env_args = origin(task, rig)
    check_origin(path, env_args)
    robots = lockstep_twins(name, task, LANES if options.policy is not None else 1, options.images)
    first = SEED_OFFSET + options.seed + last_scene(path)
    if options.policy is not None:
        recorded = policy_attempts(options.policy, task, robots, options.explore, first)
    else:
        recorded = expert_demonstrations(task, robots[0], first)
    failures, there = 0, count_episodes(path)
    with tqdm(total=options.n, initial=there, unit="demo") as bar:
        while there < options.n:  # not the bar's own count: a bar that is switched off counts nothing
            scene, seen, done, success = next(recorded)
            failures += not success
            if success or options.policy is not None:
                write_episode(path, episode_of(seen, done, success, scene), env_args)
                there += 1
                bar.update()
    log.info("%s holds %d episodes; %d attempts failed", path, options.n, failures)
    return 0


def by_a_person(options: DemoOptions) -> int:
    """--teleop, --by-hand."""
    from far_app.cli.demo_person import record
    from far_app.cli.options import RunOptions

    if options.teleop and options.by_hand:
        raise ConfigError("--teleop and --by-hand exclude each other: the arm is steered, or led by hand")
    if options.policy is not None:
        raise ConfigError("--policy records a policy's attempts; a person's demonstrations (--teleop) have none")
    run = RunOptions(
        task=options.task, robot=options.robot, rig=options.rig, host=options.host, port=options.port,
        recordings=options.recordings, judge_wait=600.0,
    )  # fmt: skip
    path, held = record(run, "hand" if options.by_hand else "teleop", options.n, options.seed, options.out)
    print(f"{path} holds {held} demonstrations: far train policy --data {path}")
    return 0


Recorded = tuple[int, list[Observation], list[np.ndarray], bool]
"""A scene, what was seen and done there, and whether it succeeded."""


def expert_demonstrations(task: TaskConfig, robot: LockstepRobot, first: int) -> Iterator[Recorded]:
    """The expert's, scene by scene without end."""
    for scene in itertools.count(first):
        yield (scene, *demonstrate(robot, robot.advance, task, robot.scale, scene))


def policy_attempts(
    checkpoint: Path, task: TaskConfig, robots: Sequence[LockstepRobot], explore: float, first: int
) -> Iterator[Recorded]:
    """First attempts of a policy in the form of `demonstrate`, as many side by side as there are robots."""
    import torch

    from far_app.cli.assemble import assemble
    from far_app.config import PerturbationConfig, RetryConfig

    torch.set_num_threads(1)
    once = dataclasses.replace(task, max_attempts=1)
    exploration = PerturbationConfig(
        kind="smoothed", probability=1.0, sigma=explore, dims=(0, 1, 2), first_attempt=1
    )  # fmt: skip
    retry = RetryConfig(perturbation=exploration)
    parts = assemble("perturb", task, str(checkpoint), None, "cpu", retry, lanes=len(robots))
    methods = [parts.another() for _ in robots]

    for block in itertools.count(first, len(robots)):  # written in order: what is on disk tells where to go on
        ended = trials(range(block, block + len(robots)), robots, methods, once)
        for scene, result in sorted(ended, key=lambda found: found[0]):
            for attempt in result.attempts:
                yield (scene, *seen_and_done(attempt), attempt.outcome.success)
