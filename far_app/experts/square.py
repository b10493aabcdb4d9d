"""Square: the nut by its handle, turned to the peg, over it, down."""

from __future__ import annotations

import numpy as np

from far_app.experts.pick import Held, carried, pick, slipped
from far_app.experts.script import Hand, Phase, Script, Steady, folded, turned, yaw_of
from far_app.types import Observation, Pose

ABOVE = 0.21
"""Metres above the table at which the nut passes over the peg's tip."""
HANDLE_SIDES = (np.pi / 2, np.pi, -np.pi / 2)
"""Where the handle may point when the nut is over the peg, radians: the arm reaches no further."""
SEATED = 0.02
"""Metres above the table to which the hand lowers the nut."""


def square(hand: Hand, start: Pose) -> Script:
    steady = Steady(np.pi)

    def handle(observation: Observation) -> np.ndarray:
        return observation.objects["handle"].position

    def nut(observation: Observation) -> Pose:
        return observation.objects["nut"]

    def across(observation: Observation) -> float:
        return steady(yaw_of(nut(observation).quaternion))

    def to_peg(up: float):
        def goal(observation: Observation) -> Pose:
            peg = observation.objects["peg"].position
            error = square_error(observation)
            at = np.array((peg[0], peg[1], table(observation) + up))
            wish = turned_by(observation.eef.quaternion, -error)
            return carried(observation, nut(observation).position, at, wish)

        return goal

    def square_error(observation: Observation) -> float:
        """From the nearest of the three orientations in which the handle does not point away from the arm."""
        yaw, peg = (yaw_of(observation.objects[name].quaternion) for name in ("nut", "peg"))
        return min((folded(yaw - peg - side, 2 * np.pi) for side in HANDLE_SIDES), key=abs)

    lost = slipped(handle)
    return Script(hand, [
        *pick(hand, start, handle, across, height=ABOVE, held=Held()),
        Phase(goal=to_peg(ABOVE), gripper=1.0, near=0.005, turn=0.05, patience=4.0, lost=lost),
        Phase(goal=to_peg(SEATED), gripper=1.0, near=0.01, turn=0.2, patience=2.0, lost=lost),
        Phase(goal=lambda o: Pose(position=o.eef.position, quaternion=o.eef.quaternion), gripper=-1.0, dwell=0.5),
        Phase(goal=lambda o: Pose(position=o.eef.position + (0, 0, 0.05), quaternion=o.eef.quaternion), gripper=-1.0),
    ])  # fmt: skip


def table(observation: Observation) -> float:
    """Height of the table's top: the peg's body stands 0.05 m above it."""
    return float(observation.objects["peg"].position[2] - 0.05)


def turned_by(quaternion: np.ndarray, yaw: float) -> np.ndarray:
    return turned(Pose(position=np.zeros(3), quaternion=quaternion), yaw)
