"""The tasks, as data. A new task is one entry here, and an expert (far_app/experts/) if demonstrations are scripted.

The paper counts policy ticks of a Panda controlled at 20 Hz, some of them repeated for three control steps; the xArm7
at 30 Hz gets the same seconds.
"""

from __future__ import annotations

from dataclasses import replace

from far_app.config import Arm, TaskConfig
from far_app.errors import ConfigError

BINS = ((0.92, 0.02, 1.62), (0.02, 0.02, 0.88))
"""Both bins and the hand between them, from the front."""
PANDA_HZ = 20.0
"""Control steps a second of the paper's simulation."""
XARM_HZ = 30.0

TASKS: dict[str, TaskConfig] = {
    "lift": TaskConfig(
        name="lift", environment="Lift", horizon=100, objects=(("cube", "cube_main"),), placement=(0.12, 0.12),
    ),
    "stack": TaskConfig(
        name="stack", environment="Stack", horizon=150, repeat=3,
        objects=(("cubeA", "cubeA_main"), ("cubeB", "cubeB_main")),
    ),
    "door": TaskConfig(
        name="door", environment="Door", horizon=200, repeat=3,
        objects=(("handle", "Door_handle"), ("door", "Door_door")), retreat=(0.0, 0.10, 0.0),
        front=((0.40, 0.62, 1.52), (-0.20, -0.15, 1.06)),
    ),
    "bread": TaskConfig(
        name="bread", environment="PickPlaceBread", horizon=200, repeat=3,
        objects=(("bread", "Bread_main"), ("bin", "bin2")), front=BINS,
    ),
    "can": TaskConfig(
        name="can", environment="PickPlaceCan", horizon=200,
        objects=(("can", "Can_main"), ("bin", "bin2")), front=BINS,
    ),
    "square": TaskConfig(
        name="square", environment="NutAssemblySquare", horizon=200,
        objects=(("nut", "SquareNut_main"), ("handle", "SquareNut_handle_site"), ("peg", "peg1")),
    ),
}  # fmt: skip
"""At the paper's pace, on the Panda."""


def task(name: str, arm: Arm = "xarm7") -> TaskConfig:
    """The entry of that name at an arm's pace, or an error that lists the choices."""
    if name not in TASKS:
        raise ConfigError(f"unknown task '{name}'; choose one of: {', '.join(sorted(TASKS))}")
    return at_pace(TASKS[name], arm)


def at_pace(entry: TaskConfig, arm: Arm) -> TaskConfig:
    """The same seconds in an arm's own ticks."""
    if arm == "panda":
        return replace(entry, rate=PANDA_HZ / entry.repeat)
    seconds = entry.horizon * entry.repeat / PANDA_HZ
    return replace(entry, rate=XARM_HZ, horizon=round(seconds * XARM_HZ), repeat=1)


def repeats(name: str, arm: str) -> int:
    """Control steps for which a policy's action is repeated; 1 where the task is not one of these."""
    return TASKS[name].repeat if name in TASKS and arm == "panda" else 1


def supervised(entry: TaskConfig) -> TaskConfig:
    """A task on a real arm: at most three attempts, success judged by a person (paper, Real-world Experiments)."""
    return replace(entry, max_attempts=min(entry.max_attempts, 3), judge="person")
