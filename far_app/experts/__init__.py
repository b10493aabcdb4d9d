"""Scripted experts: what a demonstration does, with enough chance in it that no two are copies.

An expert looks at the twin's object poses and gives the same 7-d actions a policy gives; it acts through the same
robot, safety filter and horizon. A new task's expert is one file of this form.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from far_app.config import TaskConfig
from far_app.errors import ConfigError
from far_app.experts.door import door
from far_app.experts.lift import Lift
from far_app.experts.pick_place import bread, can
from far_app.experts.script import Hand, Style
from far_app.experts.square import square
from far_app.experts.stack import stack
from far_app.motion import ActionScale
from far_app.types import Observation, Pose

Expert = Callable[[Observation], Float[np.ndarray, "A"]]
"""The action for this moment. Made anew for each demonstration."""

EXPERTS: dict[str, Callable[[Hand, Pose], Expert]] = {
    "lift": Lift, "stack": stack, "door": door, "bread": bread, "can": can, "square": square,
}  # fmt: skip


def expert(task: TaskConfig, rng: np.random.Generator, scale: ActionScale, start: Pose) -> Expert:
    """A fresh expert for one demonstration of the task."""
    if task.name not in EXPERTS:
        raise ConfigError(f"no scripted expert for task '{task.name}'; there is one for: {', '.join(sorted(EXPERTS))}")
    return EXPERTS[task.name](Hand(task, Style.draw(rng), scale, rng), start)
