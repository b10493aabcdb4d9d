"""The robot as the session's loop sees it: one observation a tick, its freshness, every acknowledgment counted."""

from __future__ import annotations

import time
from dataclasses import replace

from far_app.protocols import Home, Request, Reset, Robot
from far_app.session.statistics import LoopStatistics
from far_app.session.timeline import SEND
from far_app.types import Observation, Target


class WatchedRobot:
    """A Robot whose `observe` returns what `refresh` fetched at the tick's deadline, so that the session and the trial
    judge the same moment."""

    def __init__(self, robot: Robot, statistics: LoopStatistics) -> None:
        self.robot = robot
        self.statistics = statistics
        self.newest: Observation | None = None
        self.gripper = -1.0
        """As last commanded."""
        self._asked_home = float("-inf")

    def refresh(self) -> Observation:
        """Fetch the newest observation. Raises RobotError as Robot.observe does."""
        newest = self.robot.observe()
        for ack in newest.acks:
            self.statistics.acknowledged(ack)
        if newest.stamp < self._asked_home:  # captured before the request: its at_home is of an earlier one
            newest = replace(newest, status=replace(newest.status, at_home=False))
        self.newest = newest
        return newest

    def age(self) -> float:
        """Seconds since the newest observation was captured."""
        return time.monotonic() - self.newest.stamp if self.newest is not None else float("inf")

    def observe(self) -> Observation:
        return self.newest if self.newest is not None else self.refresh()

    def send(self, target: Target) -> None:
        self.statistics.sent(target.seq, target.due)
        self.gripper = target.gripper
        began = time.perf_counter_ns()
        self.robot.send(target)
        self.statistics.timeline.within(SEND, began)

    def request(self, request: Request) -> None:
        began = time.perf_counter_ns()
        self.robot.request(request)
        self.statistics.timeline.within(SEND, began)
        if isinstance(request, Home | Reset):
            self._asked_home = time.monotonic()

    def close(self) -> None:
        self.robot.close()
