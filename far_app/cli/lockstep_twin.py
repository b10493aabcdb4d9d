"""The twin in this process on a simulated clock, as demonstrations, evaluations and benchmarks want it."""

from __future__ import annotations

import os

from far_app.config import TaskConfig
from hw.lockstep import LockstepRobot
from hw.rig import load_rig


def lockstep_twin(rig_name: str, task: TaskConfig) -> LockstepRobot:
    """One twin with its own view; the software renderer stays on one thread, so that processes scale over cores."""
    os.environ.setdefault("LP_NUM_THREADS", "1")
    from hw.twin import TwinPlant
    from hw.twin_view import TwinView

    rig = load_rig(rig_name)
    plant = TwinPlant(rig, task)
    return LockstepRobot(plant, TwinView(plant.model_xml(), plant.base_pose()), rig, task)
