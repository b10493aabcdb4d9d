"""Stack: cube A onto cube B."""

from __future__ import annotations

import numpy as np

from far_app.experts.pick import Held, carried, pick, slipped
from far_app.experts.script import Hand, Phase, Script, Steady, turned, yaw_of
from far_app.types import Observation, Pose

HEIGHTS = 0.02 + 0.025
"""Half of cube A and half of cube B, metres."""


def stack(hand: Hand, start: Pose) -> Script:
    steady, held = Steady(np.pi / 2), Held()

    def cube(observation: Observation) -> np.ndarray:
        return observation.objects["cubeA"].position

    def yaw(observation: Observation) -> float:
        return steady(yaw_of(observation.objects["cubeA"].quaternion))

    def over_b(up: float):
        def goal(observation: Observation) -> Pose:
            above = observation.objects["cubeB"].position + (0.0, 0.0, HEIGHTS + up)
            return carried(observation, cube(observation), above, turned(start, held.yaw))

        return goal

    def away(observation: Observation) -> Pose:
        return Pose(position=cube(observation) + (0.0, 0.0, 0.12), quaternion=observation.eef.quaternion)

    lost = slipped(cube)
    return Script(hand, [
        *pick(hand, start, cube, yaw, height=0.09, held=held),
        Phase(goal=over_b(hand.style.hover), gripper=1.0, near=0.008, turn=0.5, lost=lost),
        Phase(goal=over_b(0.002), gripper=1.0, near=0.006, turn=0.5, patience=2.5, lost=lost),
        Phase(goal=lambda o: Pose(position=o.eef.position, quaternion=o.eef.quaternion), gripper=-1.0, dwell=0.5),
        Phase(goal=away, gripper=-1.0),
    ])  # fmt: skip
