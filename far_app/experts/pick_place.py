"""Bread and can: from the first bin into their quarter of the second."""

from __future__ import annotations

import math

import numpy as np

from far_app.experts.pick import Held, carried, pick, slipped
from far_app.experts.script import Hand, Phase, Script, folded, turned, yaw_of
from far_app.types import Observation, Pose

CLEARANCE = 0.20
"""Metres above where it lay, to pass over the walls between the bins."""
FIRST_BIN = np.array((0.0, -0.53, 0.0))
"""The first bin's middle, seen from the second's."""
HALF = (0.195, 0.245)
"""Half of a bin, metres."""
HAND = 0.11
"""Half of the hand's width: nearer to a wall it stays parallel to it, and the object turns between the fingers."""
DROP = 0.10
"""Metres above the bin's floor at which to let go."""


def pick_place(hand: Hand, start: Pose, name: str, quarter: tuple[float, float], square: bool, top: float) -> Script:
    """`quarter`: from the second bin's middle to where to let go, metres; `square`: the object has sides;
    `top`: how far it reaches above its middle, metres."""

    def middle(observation: Observation) -> np.ndarray:
        return observation.objects[name].position

    def yaw(observation: Observation) -> float:
        """Of the hand: across the object's sides, and its width along the wall that is nearer."""
        x, y, _ = middle(observation) - observation.objects["bin"].position - FIRST_BIN
        room = (HALF[0] - abs(x), HALF[1] - abs(y))
        along_x = room[1] < room[0]
        fits = square and min(room) > HAND
        own = folded(yaw_of(observation.objects[name].quaternion), math.pi / 2) if fits else 0.0
        return folded(own + (math.pi / 2 if along_x else 0.0), math.pi)

    def over(up: float):
        def goal(observation: Observation) -> Pose:
            place = observation.objects["bin"].position + (*quarter, up)
            return carried(observation, middle(observation), place, turned(start, 0.0))

        return goal

    lost = slipped(middle)
    return Script(hand, [
        *pick(hand, start, middle, yaw, height=CLEARANCE, held=Held(), top=top),
        Phase(goal=over(CLEARANCE), gripper=1.0, near=0.03, turn=3.2, lost=lost),
        Phase(goal=over(DROP), gripper=1.0, near=0.03, turn=3.2, patience=2.0, lost=lost),
        Phase(goal=lambda o: Pose(position=o.eef.position, quaternion=o.eef.quaternion), gripper=-1.0, dwell=0.5),
        Phase(goal=lambda o: Pose(position=o.eef.position + (0, 0, 0.05), quaternion=o.eef.quaternion), gripper=-1.0),
    ])  # fmt: skip


def bread(hand: Hand, start: Pose) -> Script:
    return pick_place(hand, start, "bread", (0.08, -0.10), square=True, top=0.02)


def can(hand: Hand, start: Pose) -> Script:
    return pick_place(hand, start, "can", (0.06, 0.09), square=False, top=0.04)
