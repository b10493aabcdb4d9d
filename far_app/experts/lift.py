"""Lift: above the cube, turn to its sides, down, close, up."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from far_app.experts.script import Hand, square_yaw, turned
from far_app.motion import rotation_between
from far_app.types import Observation, Pose


class Lift:
    def __init__(self, hand: Hand, start: Pose) -> None:
        self.hand, self.start = hand, start
        self.phase, self.held = "approach", 0

    def __call__(self, observation: Observation) -> Float[np.ndarray, "A"]:
        style, eef = self.hand.style, observation.eef
        cube = observation.objects["cube"]
        grasp = cube.position + style.offset
        aligned = turned(self.start, square_yaw(cube.quaternion))
        above = grasp + (0.0, 0.0, style.hover)
        distance = float(np.linalg.norm((above - eef.position)[:2]))
        if self.phase == "approach":
            detour = np.append(style.via * min(1.0, distance / 0.10), 0.0)
            if distance < 0.008 and np.linalg.norm(rotation_between(eef.quaternion, aligned)) < 0.12:
                self.phase = "descend"
            return self.hand.toward(observation, Pose(position=above + detour, quaternion=aligned), -1.0)
        if self.phase == "descend":
            if eef.position[2] - grasp[2] < 0.006:
                self.phase = "close"
            elif distance > 0.03:
                self.phase = "approach"
            return self.hand.toward(observation, Pose(position=grasp, quaternion=aligned), -1.0)
        if self.phase == "close":
            self.held += 1
            if self.held >= round(style.dwell * self.hand.rate):
                self.phase = "lift"
            return self.hand.toward(observation, Pose(position=grasp, quaternion=aligned), 1.0)
        if observation.gripper < 0.15:  # closed on nothing
            self.phase, self.held = "approach", 0
        up = eef.position + (0.0, 0.0, 0.05)
        return self.hand.toward(observation, Pose(position=up, quaternion=aligned), 1.0)
