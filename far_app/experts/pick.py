"""Picking from above, as stack, bread, can and square begin: over the object, down, close, up."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from far_app.experts.script import Hand, Phase, turned
from far_app.types import Observation, Pose

SLIPPED = 0.06
"""Metres between hand and grasp from which the object is no longer in the hand."""


@dataclass
class Held:
    """How the object was taken. Once it is in the hand it turns with the hand, and says no more of how to turn it."""

    height: float = 0.0
    """Of the grasp where it lay, metres."""
    yaw: float = 0.0
    """Of the hand, radians."""


def pick(
    hand: Hand, start: Pose, grasp: Callable[[Observation], np.ndarray], yaw: Callable[[Observation], float],
    height: float, held: Held, top: float = 0.0, close: float = 1.0,
) -> list[Phase]:  # fmt: skip
    """Phases until the object hangs `height` above where it lay; `grasp` and `yaw` say where and how to take it, `top`
    how far the object reaches above the grasp (metres), `close` how firmly to take it, in (0, 1]."""
    style = hand.style

    def at(observation: Observation, up: float) -> Pose:
        position = grasp(observation) + style.offset + (0.0, 0.0, up)
        return Pose(position=position, quaternion=turned(start, yaw(observation)))

    def over(observation: Observation) -> Pose:
        goal = at(observation, top + style.hover)
        distance = float(np.linalg.norm((goal.position - observation.eef.position)[:2]))
        detour = np.append(style.via * min(1.0, max(0.0, distance - 0.02) / 0.10), 0.0)
        return Pose(position=goal.position + detour, quaternion=goal.quaternion)

    def down(observation: Observation) -> Pose:
        held.height, held.yaw = float(grasp(observation)[2]), yaw(observation)
        return at(observation, 0.0)

    def up(observation: Observation) -> Pose:
        position = observation.eef.position.copy()
        position[2] = held.height + height
        return Pose(position=position, quaternion=turned(start, held.yaw))

    def strayed(observation: Observation) -> bool:
        return bool(np.linalg.norm((grasp(observation) + style.offset - observation.eef.position)[:2]) > 0.03)

    return [
        Phase(goal=over, gripper=-1.0, near=0.012),
        Phase(goal=down, gripper=-1.0, near=0.008, patience=2.0, lost=strayed),
        Phase(goal=down, gripper=close, done=Closed(), least=style.dwell, patience=2.0),
        Phase(goal=up, gripper=close, near=0.02, turn=0.5, lost=slipped(grasp)),
    ]


class Closed:
    """Whether the fingers have come to rest on something (or on each other)."""

    def __init__(self) -> None:
        self.before = 1.0

    def __call__(self, observation: Observation) -> bool:
        moved, self.before = self.before - observation.gripper, observation.gripper
        return observation.gripper < 0.97 and abs(moved) < 0.02


def slipped(grasp: Callable[[Observation], np.ndarray]) -> Callable[[Observation], bool]:
    """Whether the object is no longer in the hand."""
    return lambda observation: bool(np.linalg.norm(grasp(observation) - observation.eef.position) > SLIPPED)


def carried(observation: Observation, carried_at: np.ndarray, goal: np.ndarray, quaternion: np.ndarray) -> Pose:
    """Where the hand must be for what it carries (now at `carried_at`) to come to the goal."""
    return Pose(position=observation.eef.position + goal - carried_at, quaternion=quaternion)
