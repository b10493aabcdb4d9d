"""A real-time robot without physics for the session's own tests: it goes where it is told, at once.

The twin behind the hw server is exercised by tests/test_end_to_end.py; here the session's timing and state are the
subject, so the robot's misbehaviour (staleness, faults, latches, silence) is set by the test.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from far_app.errors import RobotError
from far_app.protocols import Heartbeat, Hold, Home, PolicySpec, Request, Reset, Resume
from far_app.types import Ack, ActionChunk, Adaptation, Observation, Pose, RobotMode, RobotStatus, Target

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
HOME = Pose(position=np.array([0.4, 0.0, 0.3]), quaternion=IDENTITY)


class KinematicRobot:
    """Success is reaching x ≥ goal; homing takes `homing_ticks` observations."""

    def __init__(self, goal: float = 0.45, homing_ticks: int = 3) -> None:
        self.pose, self.goal, self.homing_ticks = HOME, goal, homing_ticks
        self.status = RobotStatus(mode=RobotMode.HOLD)
        self.requests: list[Request] = []
        self.targets: list[Target] = []
        self.freeze_stamp: float | None = None
        self.silent = False
        self.closed = False
        self._acks: list[Ack] = []
        self._seq = 0
        self._homing_left = 0

    def observe(self) -> Observation:
        if self.silent:
            raise RobotError("no observation for 1 s: is the hardware server alive?")
        if self.status.mode is RobotMode.HOMING:
            self._homing_left -= 1
            if self._homing_left <= 0:
                self.pose, self.status = HOME, replace(self.status, mode=RobotMode.HOLD, at_home=True)
        self._seq += 1
        acks, self._acks = tuple(self._acks), []
        stamp = self.freeze_stamp if self.freeze_stamp is not None else time.monotonic()
        return Observation(
            seq=self._seq, stamp=stamp, eef=self.pose, gripper=1.0, joints=np.zeros(7), status=self.status, acks=acks,
            success=bool(self.pose.position[0] >= self.goal),
        )  # fmt: skip

    def send(self, target: Target) -> None:
        now = time.monotonic()
        refused = "latched" if self.status.mode is RobotMode.LATCHED else "expired" if now > target.expires else ""
        if not refused:
            self.pose = target.pose
            self.status = replace(self.status, mode=RobotMode.TRACKING, at_home=False)
            self.targets.append(target)
        self._acks.append(
            Ack(seq=target.seq, accepted=now, due=target.due, pose=self.pose, gripper=target.gripper, refused=refused)
        )

    def request(self, request: Request) -> None:
        if self.silent:
            raise RobotError("the hardware server did not answer within 1 s")
        if not isinstance(request, Heartbeat):
            self.requests.append(request)
        latched = self.status.mode is RobotMode.LATCHED
        if latched and isinstance(request, Reset | Home):
            raise RobotError(f"refused: {self.status.reason}")
        match request:
            case Reset(seed=seed):
                self.status = RobotStatus(mode=RobotMode.HOLD, scene_seed=seed)
            case Home():
                self._homing_left = self.homing_ticks
                self.status = replace(self.status, mode=RobotMode.HOMING, at_home=False)
            case Hold(reason=reason, latch=latch):
                if not latched:
                    mode = RobotMode.LATCHED if latch else RobotMode.HOLD
                    self.status = replace(self.status, mode=mode, reason=reason)
            case Resume():
                self.status = RobotStatus(mode=RobotMode.HOLD)

    def latch(self, reason: str, fault: bool = False) -> None:
        self.status = replace(self.status, mode=RobotMode.LATCHED, reason=reason, fault=fault)

    def close(self) -> None:
        self.closed = True


class Forward:
    """A policy that pushes along x; `poison` makes it plan NaN from that tick on; `seconds` is its inference time."""

    def __init__(self, speed: float = 0.5, seconds: float = 0.0, poison: int | None = None) -> None:
        self.spec = PolicySpec(
            name="forward", task="lift", horizon=8, n_obs=2, action_dim=7, cameras=(), image_size=0, state_keys=()
        )
        self.version = "forward-0"
        self.speed, self.seconds, self.poison = speed, seconds, poison
        self.noises: dict[int, np.ndarray] = {}

    def plan(self, histories, ticks, noise):
        time.sleep(self.seconds)
        actions = np.zeros((8, 7))
        actions[:, 0] = self.speed
        if self.poison is not None and ticks[0] >= self.poison:
            actions[:] = np.nan
        self.noises[ticks[0]] = noise[0]
        return [ActionChunk(tick=ticks[0], actions=actions, policy_version=self.version, value=-1.0)]


class Faster:
    """A method whose adaptation doubles the policy's speed."""

    name = "faster"

    def __init__(self, policy: Forward, adapting_seconds: float = 0.0) -> None:
        self._base, self.policy, self.adapting_seconds = policy, policy, adapting_seconds
        self.adapted_attempts: list[int] = []

    def begin(self, scene_seed: int) -> None:
        self.policy = self._base

    def adapt(self, attempt, cancelled, progress) -> Adaptation:
        base = self.policy.version
        self.adapted_attempts.append(attempt.index)
        end = time.monotonic() + self.adapting_seconds
        status = "adapted"
        while time.monotonic() < end:
            if cancelled():
                status = "cancelled"
                break
            time.sleep(0.01)
        if status == "adapted":
            self.policy = Forward(self.policy.speed * 2, self.policy.seconds)
            self.policy.version = f"{base}+{attempt.index}"
        return Adaptation(
            status=status, base_version=base, version=self.policy.version, values=np.zeros(0), pairs=1,
            value_changes=np.zeros(0), threshold=float("nan"), flagged=(),
        )  # fmt: skip

    def perturb(self, attempt_index: int, scene_seed: int):
        return lambda tick: np.zeros(7)
