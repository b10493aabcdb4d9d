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
CLEARLY = 0.02
"""Metres of room for which the hand changes its mind."""
GENTLY = 0.5
"""Of a full closing: the bread is light and slips out of a firm hand."""
DROP = 0.10
"""Metres above the bin's floor at which to let go."""


def shortage(room: tuple[float, float], yaw: float) -> float:
    """Metres by which the hand at this yaw reaches into the walls; `room`: to the nearer ones, in x and in y."""
    across, along = abs(math.sin(yaw)), abs(math.cos(yaw))
    extent = (HAND[1] * across + HAND[0] * along, HAND[1] * along + HAND[0] * across)
    return max(0.0, extent[0] - room[0], extent[1] - room[1])


class QuarterTurn:
    """By which quarter turn the hand takes an object's sides: the smallest that the walls leave room for. It keeps to
    its choice until another leaves clearly more room."""

    def __init__(self) -> None:
        self.chosen: float | None = None

    def __call__(self, room: tuple[float, float], own: float) -> float:
        """`own`: the object's yaw; returns the hand's."""
        best = min((0.0, QUARTER, -QUARTER), key=lambda turn: (round(shortage(room, own + turn), 3), abs(own + turn)))
        if self.chosen is None or shortage(room, own + self.chosen) > shortage(room, own + best) + CLEARLY:
            self.chosen = best
        return own + self.chosen


def pick_place(
    hand: Hand, start: Pose, name: str, quarter: tuple[float, float], square: bool, top: float,
    grip: float = 0.0, close: float = 1.0,
) -> Script:  # fmt: skip
    """`quarter`: from the second bin's middle to where to let go, metres; `square`: the object has sides;
    `top`: how far above its middle the way to it leads, `grip`: how far above its middle to take it, metres;
    `close`: how firmly, in (0, 1]."""

    def middle(observation: Observation) -> np.ndarray:
        return observation.objects[name].position

    def grasp(observation: Observation) -> np.ndarray:
        return middle(observation) + (0.0, 0.0, grip)

    steady, across, held = Steady(QUARTER), QuarterTurn(), Held()

    def yaw(observation: Observation) -> float:
        """Of the hand: across the object's sides, the way that the walls leave room for."""
        x, y, _ = middle(observation) - observation.objects["bin"].position - FIRST_BIN
        own = steady(yaw_of(observation.objects[name].quaternion)) if square else 0.0
        return across((HALF[0] - abs(x), HALF[1] - abs(y)), own)

    def over(height: float):
        def goal(observation: Observation) -> Pose:
            place = observation.objects["bin"].position + (*quarter, height)
            return carried(observation, middle(observation), place, turned(start, held.yaw))

        return goal

    lost = slipped(middle)
    return Script(hand, [
        *pick(hand, start, grasp, yaw, height=LIFT, held=held, top=top, close=close),
        Phase(goal=over(CLEARANCE), gripper=close, near=0.03, turn=3.2, lost=lost),
        Phase(goal=over(DROP), gripper=close, near=0.03, turn=3.2, patience=2.0, lost=lost),
        Phase(goal=lambda o: Pose(position=o.eef.position, quaternion=o.eef.quaternion), gripper=-1.0, dwell=0.5),
        Phase(goal=lambda o: Pose(position=o.eef.position + (0, 0, 0.05), quaternion=o.eef.quaternion), gripper=-1.0),
    ])  # fmt: skip


def bread(hand: Hand, start: Pose) -> Script:
    return pick_place(hand, start, "bread", (0.08, -0.10), square=True, top=0.05, grip=0.008, close=GENTLY)


def can(hand: Hand, start: Pose) -> Script:
    return pick_place(hand, start, "can", (0.06, 0.08), square=False, top=0.04)
