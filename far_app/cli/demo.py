"""`far demo`: demonstrations by the scripted expert, in lockstep with the twin, appended to an HDF5 file."""

from __future__ import annotations

import dataclasses
import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from tqdm import tqdm

from far_app.demonstrations import SEED_OFFSET, demonstrate
from far_app.learning.dataset import count_episodes, episode_of, write_episode
from far_app.tasks import task as find_task
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
    rig: str = "twin"


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(DemoOptions, args=list(arguments), prog="far demo")
    os.environ.setdefault("LP_NUM_THREADS", "1")
    from hw.lockstep import LockstepRobot
    from hw.twin import TwinPlant
    from hw.twin_view import TwinView

    task, rig = find_task(options.task), load_rig(options.rig)
    path = options.out or Path("datasets") / f"{task.name}.hdf5"
    plant = TwinPlant(rig, task)
    robot = LockstepRobot(plant, TwinView(plant.model_xml(), plant.base_pose()), rig, task)
    env_args = {
        "env_name": task.environment,
        "type": 1,
        "env_kwargs": {"robots": "XArm7", "rig": dataclasses.asdict(rig)},
    }
    scene = SEED_OFFSET + options.seed + count_episodes(path)
    failures = 0
    with tqdm(total=options.n, initial=count_episodes(path), unit="demo") as bar:
        while bar.n < options.n:
            seen, done, success = demonstrate(robot, robot.advance, task, rig.scale, scene)
            if success:
                objects = np.array(
                    [np.concatenate([[*p.position, *p.quaternion] for p in o.objects.values()]) for o in seen]
                )
                write_episode(path, episode_of(seen, done, True, scene), objects, env_args)
                bar.update()
            else:
                failures += 1
            scene += 1
    log.info("%s holds %d demonstrations; the expert failed %d times", path, options.n, failures)
    return 0
