"""The shadow run: the policy looks and plans, its path is shown, and the arm stays where it is.

Whatever would move the arm ends here: no target, no way home and no scene reset leaves the app. Holding, resuming and
observing go through. Wrapped around a session's robot by `far run --shadow`.
"""

from __future__ import annotations

import time
from dataclasses import replace

from far_app.protocols import Hold, Request, Resume, Robot
from far_app.types import Ack, Observation, Target

WITHHELD = "shadow run: the arm is held"


class ShadowRobot:
    """far_app.protocols.Robot that shows another robot and moves it never."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._acks: list[Ack] = []

    def observe(self) -> Observation:
        """As it is, and at home wherever it stands: an attempt begins there. Targets are answered as refused."""
        observation = self._robot.observe()
        acks, self._acks = tuple(self._acks), []
        return replace(observation, acks=acks, status=replace(observation.status, at_home=True))

    def send(self, target: Target) -> None:
        self._acks.append(Ack(
            seq=target.seq, accepted=max(time.monotonic(), target.due), due=target.due, pose=target.pose,
            gripper=target.gripper, refused=WITHHELD,
        ))  # fmt: skip

    def request(self, request: Request) -> None:
        if isinstance(request, Hold | Resume):
            self._robot.request(request)

    def close(self) -> None:
        self._robot.close()
