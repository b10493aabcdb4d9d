"""Door: from the front, fingers above and below the lever; turn it down, pull the door open."""

from __future__ import annotations

import math

import numpy as np

from far_app.experts.script import DOWN, Hand, Phase, Script, turned, yaw_of
from far_app.motion import quat_from_rotvec, quat_inverse, quat_multiply, rotation_between
from far_app.types import Observation, Pose

PRESSED = 1.4
"""Radians the lever is turned before the door is pulled."""
AHEAD = 0.04
"""Metres beyond the lever at which the hand aims while it turns or pulls."""
TURN_AHEAD = 0.15
"""Radians, the same."""
IN_LINE = 0.006
"""Metres beside the lever's line within which the hand may go on to it; beyond that it keeps FUNNEL times its error
away."""
FUNNEL = 6.0
SLIPPED = 0.07
"""Metres between hand and lever from which it is no longer in the hand."""
EMPTY = 0.2
"""Opening of a hand that has closed on nothing."""
FORWARD = quat_from_rotvec(np.array((-math.pi / 2, 0.0, 0.0)))
"""From a hand that points down to one that points at a wall on its right, its fingers one above the other."""


def door(hand: Hand, start: Pose) -> Script:
    style = hand.style

    def lever(observation: Observation) -> np.ndarray:
        return observation.objects["handle"].position

    def facing(observation: Observation, ahead: float = 0.0) -> np.ndarray:
        """The hand points into the door and is turned as far as the lever, and a little further."""
        outward = normal(observation)
        level = turned(Pose(position=np.zeros(3), quaternion=quat_multiply(FORWARD, start.quaternion)),
                       math.atan2(outward[1], outward[0]) - math.pi / 2)  # fmt: skip
        return quat_multiply(quat_from_rotvec(-(turned_down(observation) + ahead) * outward), level)

    def at(observation: Observation, way: np.ndarray, ahead: float = 0.0) -> Pose:
        return Pose(position=lever(observation) + style.offset + way, quaternion=facing(observation, ahead))

    def before(observation: Observation) -> Pose:
        return at(observation, (0.05 + style.hover) * normal(observation))

    def onto(observation: Observation) -> Pose:
        """Straight on to the lever; no nearer than the hand is in line with it."""
        offset, outward = observation.eef.position - lever(observation) - style.offset, normal(observation)
        beside = float(np.linalg.norm(offset - (offset @ outward) * outward))
        return at(observation, FUNNEL * max(0.0, beside - IN_LINE) * outward)

    def there(observation: Observation) -> Pose:
        return at(observation, np.zeros(3))

    def around(observation: Observation) -> bool:
        """The lever is between the fingers."""
        return bool(np.linalg.norm(there(observation).position - observation.eef.position) < 0.012)

    def onward(observation: Observation) -> np.ndarray:
        """The way the lever's end goes as it turns: down, then ever more to the side."""
        angle, side = turned_down(observation), np.cross(normal(observation), DOWN)
        return math.sin(angle) * side - math.cos(angle) * DOWN

    def turn(observation: Observation) -> Pose:
        return at(observation, AHEAD * onward(observation), TURN_AHEAD)

    def pull(observation: Observation) -> Pose:
        if observation.success:
            return observation.eef
        return at(observation, 0.6 * AHEAD * normal(observation), TURN_AHEAD)

    def lost(observation: Observation) -> bool:
        away = np.linalg.norm(lever(observation) - observation.eef.position) > SLIPPED
        return not observation.success and (bool(away) or observation.gripper < EMPTY)

    return Script(hand, [
        Phase(goal=before, gripper=-1.0, near=0.012, turn=0.08),
        Phase(goal=onto, gripper=-1.0, pace=0.7, done=around, patience=3.0),
        Phase(goal=there, gripper=1.0, near=0.03, turn=0.3, dwell=style.dwell, patience=1.0),
        Phase(goal=turn, gripper=1.0, done=lambda o: turned_down(o) > PRESSED, patience=4.0, lost=lost),
        Phase(goal=pull, gripper=1.0, lost=lost),
    ])  # fmt: skip


def normal(observation: Observation) -> np.ndarray:
    """Out of the door, on the lever's side: its own −y, level."""
    yaw = yaw_of(observation.objects["door"].quaternion)
    return np.array((math.sin(yaw), -math.cos(yaw), 0.0))


def turned_down(observation: Observation) -> float:
    """How far the lever is turned against the door, radians."""
    objects = observation.objects
    relative = quat_multiply(quat_inverse(objects["door"].quaternion), objects["handle"].quaternion)
    return float(np.linalg.norm(rotation_between(np.array((0.0, 0.0, 0.0, 1.0)), relative)))
