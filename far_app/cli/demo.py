"""`far demo`: demonstrations by the scripted expert, in lockstep with the twin, appended to an HDF5 file.

With --policy it records a policy's own attempts instead, whatever their outcome: what a critic learns failure from.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from tqdm import tqdm

from far_app.cli.lockstep_twin import lockstep_twin
from far_app.config import TaskConfig
from far_app.demonstrations import SEED_OFFSET, demonstrate
from far_app.learning.dataset import check_origin, count_episodes, episode_of, last_scene, write_episode
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
    """HDF5 file; datasets/TASK.hdf5 by default."""
    policy: Path | None = None
    """Record this policy's attempts instead of the expert's demonstrations."""
    explore: float = 0.0
    """With --policy: standard deviation of smoothed perturbations of the translation, in action units. A critic learns
    from them what other actions would have led to."""
    rig: str = "twin"
    images: bool = True
    """Draw the cameras; a policy of the `state` preset needs none."""


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(DemoOptions, args=list(arguments), prog="far demo")
    task = find_task(options.task, load_rig(options.rig).arm)
    robot = lockstep_twin(options.rig, task, options.images)
    path = options.out or Path("datasets") / f"{task.name}.hdf5"
    env_args = {
        "env_name": task.environment, "type": 1,
        "env_kwargs": {"robots": robot.rig.arm, "rig": dataclasses.asdict(robot.rig)},
    }  # fmt: skip
    check_origin(path, env_args)
    attempt = policy_attempt(options.policy, task, robot, options.explore) if options.policy is not None else None
    scene = SEED_OFFSET + options.seed + last_scene(path)
    failures = 0
    with tqdm(total=options.n, initial=count_episodes(path), unit="demo") as bar:
        while bar.n < options.n:
            if attempt is not None:
                seen, done, success = attempt(scene)
            else:
                seen, done, success = demonstrate(robot, robot.advance, task, robot.scale, scene)
            failures += not success
            if success or attempt is not None:
                objects = np.array(
                    [np.concatenate([[*p.position, *p.quaternion] for p in o.objects.values()]) for o in seen]
                )
                write_episode(path, episode_of(seen, done, success, scene), objects, env_args)
                bar.update()
            scene += 1
    log.info("%s holds %d episodes; %d attempts failed", path, options.n, failures)
    return 0


Recorded = tuple[list[Observation], list[np.ndarray], bool]


def policy_attempt(
    checkpoint: Path, task: TaskConfig, robot: LockstepRobot, explore: float
) -> Callable[[int], Recorded]:
    """First attempts of a policy, by scene, in the form of `demonstrate`."""
    import torch

    from far_app.cli.assemble import assemble
    from far_app.config import PerturbationConfig, RetryConfig
    from far_app.detectors import TwinCheck
    from far_app.session.lockstep import adapt_at_once, run_lockstep
    from far_app.session.planners import LockstepPlanner
    from far_app.trial import trial

    torch.set_num_threads(1)
    once = dataclasses.replace(task, max_attempts=1)
    exploration = PerturbationConfig(
        kind="smoothed", probability=1.0, sigma=explore, dims=(0, 1, 2), first_attempt=1
    )  # fmt: skip
    method = assemble("perturb", task, str(checkpoint), None, "cpu", RetryConfig(perturbation=exploration)).method

    def attempt(scene: int) -> Recorded:
        events = trial(
            scene, robot, LockstepPlanner(), method, TwinCheck(task.success_ticks), once, robot.scale, adapt_at_once
        )
        (first,) = run_lockstep(events, robot.advance).attempts
        actions = [s.sent if np.isfinite(s.sent).all() else s.commanded for s in first.steps]
        seen = [*(s.observation for s in first.steps), first.final]
        return seen, [*actions, actions[-1]], first.outcome.success

    return attempt
