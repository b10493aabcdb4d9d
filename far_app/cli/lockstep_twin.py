"""The twin in this process on a simulated clock, as demonstrations, evaluations and benchmarks want it."""

from __future__ import annotations

import os

from far_app.config import TaskConfig
from hw.lockstep import LockstepRobot
from hw.rig import load_rig


def lockstep_twin(rig_name: str, task: TaskConfig, images: bool = True) -> LockstepRobot:
    """One twin, with a view of its own where images are wanted."""
    return lockstep_twins(rig_name, task, 1, images)[0]


def lockstep_twins(rig_name: str, task: TaskConfig, count: int, images: bool = True) -> list[LockstepRobot]:
    """Several twins of one scene that share a view; the software renderer stays on one thread, so that processes
    scale over cores."""
    os.environ.setdefault("LP_NUM_THREADS", "1")
    from hw.twin import TwinPlant
    from hw.twin_view import TwinView

    rig = load_rig(rig_name)
    plants = [TwinPlant(rig, task) for _ in range(count)]
    view = TwinView(plants[0].model_xml(), plants[0].base_pose(), plants[0].cameras()) if images else None
    return [LockstepRobot(plant, view, rig, task) for plant in plants]
