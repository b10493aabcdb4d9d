"""Bread and can: from the first bin into their quarter of the second."""

from __future__ import annotations

import math

import numpy as np

from far_app.experts.pick import Held, carried, pick, slipped
from far_app.experts.script import Hand, Phase, Script, Steady, turned, yaw_of
from far_app.types import Observation, Pose

LIFT = 0.15
"""Metres above where it lay, to pass over the walls between the bins."""
CLEARANCE = 0.20
"""Metres above the second bin's floor, the same."""
FIRST_BIN = np.array((0.0, -0.53, 0.0))
"""The first bin's middle, seen from the second's."""
HALF = (0.195, 0.245)
"""Half of a bin, metres."""
HAND = (0.04, 0.11)
"""Half of the hand's thickness and of its width, metres: what it needs of the room to the walls."""
QUARTER = math.pi / 2
DROP = 0.10
"""Metres above the bin's floor at which to let go."""


class Ways:
    """Which of the turns that take the object alike the hand makes: the smallest that no wall forbids. It keeps to its
    choice until that becomes worse than another by HALT."""

    HALT = 0.02

    def __init__(self) -> None:
        self.turn: float | None = None

    def __call__(self, room: tuple[float, float], own: float, turns: tuple[float, ...]) -> float:
        def short(turn: float) -> float:
            """Metres that the nearer walls leave too little."""
            across, along = abs(math.sin(own + turn)), abs(math.cos(own + turn))
            extent = (HAND[1] * across + HAND[0] * along, HAND[1] * along + HAND[0] * across)
            return max(0.0, *(needed - there for needed, there in zip(extent, room, strict=True)))

        best = min(turns, key=lambda turn: (round(short(turn), 3), abs(own + turn)))
        if self.turn is None or short(self.turn) > short(best) + self.HALT:
            self.turn = best
        return self.turn


def pick_place(hand: Hand, start: Pose, name: str, quarter: tuple[float, float], square: bool, top: float, up: float) -> Script:
    """`quarter`: from the second bin's middle to where to let go, metres; `square`: the object has sides;
    `top`: how far above its middle to come and go, metres, `up`: to take it."""

    def middle(observation: Observation) -> np.ndarray:
        return observation.objects[name].position

    def grasp(observation: Observation) -> np.ndarray:
        return middle(observation) + (0.0, 0.0, up)

    steady, ways = Steady(QUARTER), Ways()

    def yaw(observation: Observation) -> float:
        """Of the hand: across the object's sides, the way that the walls leave room for."""
        x, y, _ = middle(observation) - observation.objects["bin"].position - FIRST_BIN
        own = steady(yaw_of(observation.objects[name].quaternion)) if square else 0.0
        return own + ways((HALF[0] - abs(x), HALF[1] - abs(y)), own, (0.0, QUARTER, -QUARTER))

    def over(height: float):
        def goal(observation: Observation) -> Pose:
            place = observation.objects["bin"].position + (*quarter, height)
            return carried(observation, middle(observation), place, turned(start, 0.0))

        return goal

    lost = slipped(middle)
    return Script(hand, [
        *pick(hand, start, grasp, yaw, height=LIFT, held=Held(), top=top),
        Phase(goal=over(CLEARANCE), gripper=1.0, near=0.03, turn=3.2, lost=lost),
        Phase(goal=over(DROP), gripper=1.0, near=0.03, turn=3.2, patience=2.0, lost=lost),
        Phase(goal=lambda o: Pose(position=o.eef.position, quaternion=o.eef.quaternion), gripper=-1.0, dwell=0.5),
        Phase(goal=lambda o: Pose(position=o.eef.position + (0, 0, 0.05), quaternion=o.eef.quaternion), gripper=-1.0),
    ])  # fmt: skip


def bread(hand: Hand, start: Pose) -> Script:
    return pick_place(hand, start, "bread", (0.08, -0.10), square=True, top=0.05, up=0.008)


def can(hand: Hand, start: Pose) -> Script:
    return pick_place(hand, start, "can", (0.06, 0.08), square=False, top=0.04, up=0.0)
