"""Bread and can: from the first bin into their quarter of the second."""

from __future__ import annotations

import math

import numpy as np

from far_app.experts.pick import carried, pick, slipped
from far_app.experts.script import Hand, Phase, Script, folded, turned, yaw_of
from far_app.types import Observation, Pose

CLEARANCE = 0.20
"""Metres above where it lay, to pass over the walls between the bins."""
FIRST_BIN = np.array((0.0, -0.53, 0.0))
"""The first bin's middle, seen from the second's."""
HALF = (0.195, 0.245)
"""Half of a bin, metres."""
DROP = 0.10
"""Metres above the bin's floor at which to let go."""


def pick_place(hand: Hand, start: Pose, name: str, quarter: tuple[float, float], square: bool) -> Script:
    """`quarter`: from the second bin's middle to where to let go, metres; `square`: the object has sides."""
    chosen = [0.0]

    def middle(observation: Observation) -> np.ndarray:
        return observation.objects[name].position

    def yaw(observation: Observation) -> float:
        """Of the hand: across the object's sides, and its width along the wall that is nearer."""
        x, y, _ = middle(observation) - observation.objects["bin"].position - FIRST_BIN
        along_x = HALF[1] - abs(y) < HALF[0] - abs(x)
        own = folded(yaw_of(observation.objects[name].quaternion), math.pi / 2) if square else 0.0
        return folded(own + (math.pi / 2 if along_x else 0.0), math.pi)

    def before_lifting(observation: Observation) -> float:
        """The yaw of the hand as it was when the object still lay."""
        if script.index < 3:
            chosen[:] = [yaw(observation)]
        return chosen[0]

    def over(up: float):
        def goal(observation: Observation) -> Pose:
            place = observation.objects["bin"].position + (*quarter, up)
            return carried(observation, middle(observation), place, turned(start, 0.0))

        return goal

    lost = slipped(middle)
    script = Script(hand, [
        *pick(hand, start, middle, before_lifting, height=CLEARANCE),
        Phase(goal=over(CLEARANCE), gripper=1.0, near=0.03, turn=3.2, lost=lost),
        Phase(goal=over(DROP), gripper=1.0, near=0.03, turn=3.2, patience=2.0, lost=lost),
        Phase(goal=lambda o: Pose(position=o.eef.position, quaternion=o.eef.quaternion), gripper=-1.0, dwell=0.5),
        Phase(goal=lambda o: Pose(position=o.eef.position + (0, 0, 0.05), quaternion=o.eef.quaternion), gripper=-1.0),
    ])  # fmt: skip
    return script


def bread(hand: Hand, start: Pose) -> Script:
    return pick_place(hand, start, "bread", (0.08, -0.10), square=True)


def can(hand: Hand, start: Pose) -> Script:
    return pick_place(hand, start, "can", (0.06, 0.09), square=False)
