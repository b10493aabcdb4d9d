"""Square: the nut by its handle, turned to the peg, over it, down."""

from __future__ import annotations

import numpy as np

from far_app.experts.pick import Held, carried, pick, slipped
from far_app.experts.script import Hand, Phase, Script, Steady, folded, turned, yaw_of
from far_app.types import Observation, Pose

ABOVE = 0.19
"""Metres above the table at which the nut passes over the peg's tip."""
TIP = 0.13
"""Metres above the table, of the peg."""
HANDLE = 0.054
"""Metres from the nut's middle to its handle's."""
HANDLE_SIDES = (np.pi / 2, np.pi, -np.pi / 2)
"""Where the handle may point when the nut is over the peg, radians."""
FURTHER = 0.005
"""Metres by which the hand may then be further from the arm's base than the peg is."""
RISE = 0.005
"""Metres above the handle's middle at which it is taken: fingers that press on the table do not close."""
OUTWARD = 0.014
"""Metres beyond the handle's middle at which it is taken: broad fingers would stand on the ring."""
ALIGNED = 0.005
"""Metres beside the peg with which the nut may begin to go down."""
THREADED = 0.012
"""Metres beside the peg at which a nut below its tip can only be around it."""


def square(hand: Hand, start: Pose) -> Script:
    steady, flips = Steady(np.pi), list[float]()

    def handle(observation: Observation) -> np.ndarray:
        """Where to take it."""
        middle = observation.objects["handle"].position
        outward = middle - observation.objects["nut"].position
        return middle + OUTWARD * outward / np.linalg.norm(outward) + (0.0, 0.0, RISE)

    def nut(observation: Observation) -> Pose:
        return observation.objects["nut"]

    def across(observation: Observation) -> float:
        """Either way round, whichever leaves the hand less turned both here and over the peg."""
        yaw = steady(yaw_of(nut(observation).quaternion))
        if not flips:
            error = square_error(observation)
            flips.append(min((0.0, np.pi, -np.pi), key=lambda f: max(abs(yaw + f), abs(yaw + f - error))))
        return yaw + flips[0]

    def over_peg(observation: Observation, up: float = ABOVE) -> Pose:
        peg = observation.objects["peg"].position
        at = np.array((peg[0], peg[1], table(observation) + up))
        wish = turned_by(observation.eef.quaternion, -square_error(observation))
        return carried(observation, nut(observation).position, at, wish)

    def onto_peg(observation: Observation) -> Pose:
        """Down while the nut is where the hole meets the peg, else back over its tip."""
        offset = nut(observation).position - observation.objects["peg"].position
        below = nut(observation).position[2] < table(observation) + TIP - 0.01
        beside = float(np.linalg.norm(offset[:2]))
        return over_peg(observation, 0.0 if beside < (THREADED if below else 2 * ALIGNED) else ABOVE)

    def seated(observation: Observation) -> bool:
        return bool(nut(observation).position[2] < table(observation) + 0.03)

    def square_error(observation: Observation) -> float:
        """From the nearest orientation in which the arm reaches the handle."""
        peg = observation.objects["peg"]
        yaw, peg_yaw = yaw_of(nut(observation).quaternion), yaw_of(peg.quaternion)

        def further(side: float) -> float:
            way = np.array((np.cos(peg_yaw + side), np.sin(peg_yaw + side)))
            at = peg.position[:2] + (HANDLE + OUTWARD) * way
            return float(np.linalg.norm(at) - np.linalg.norm(peg.position[:2]))

        reached = [side for side in HANDLE_SIDES if further(side) < FURTHER]
        return min((folded(yaw - peg_yaw - side, 2 * np.pi) for side in reached), key=abs)

    lost = slipped(handle)
    return Script(hand, [
        *pick(hand, start, handle, across, height=ABOVE, held=Held()),
        Phase(goal=over_peg, gripper=1.0, near=ALIGNED, turn=0.06, pace=0.85, dwell=0.2, patience=5.0, lost=lost),
        Phase(goal=onto_peg, gripper=1.0, done=seated, patience=4.0, lost=lost),
        Phase(goal=lambda o: Pose(position=o.eef.position, quaternion=o.eef.quaternion), gripper=-1.0, dwell=0.5),
        Phase(goal=lambda o: Pose(position=o.eef.position + (0, 0, 0.05), quaternion=o.eef.quaternion), gripper=-1.0),
    ])  # fmt: skip


def table(observation: Observation) -> float:
    """Height of the table's top: the peg's middle is 0.03 m above it."""
    return float(observation.objects["peg"].position[2] - 0.03)


def turned_by(quaternion: np.ndarray, yaw: float) -> np.ndarray:
    return turned(Pose(position=np.zeros(3), quaternion=quaternion), yaw)
