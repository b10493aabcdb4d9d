"""The twin: a robosuite arm (xArm7, Panda) as a plant the controller moves at 120 Hz, in simulated time.

robosuite's environment gives the model, the scene and the task's own check; stepping, timing, the arm's impedance law
(hw/osc.py) and the gripper's speed are ours, so that one servo tick is exactly 1/120 s and targets are absolute poses.
"""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco
import numpy as np
from jaxtyping import Float

from far_app.config import TaskConfig
from far_app.errors import RobotError
from far_app.motion import quat_inverse, quat_multiply
from far_app.types import Pose
from hw.osc import OperationalSpace
from hw.plant import Measured
from hw.rig import RigConfig
from hw.twin_arms import ARMS
from hw.twin_view import CameraPlacement

SERVO_HZ = 120
SUBSTEPS = 4
"""Physics steps a servo tick: 1/480 s each."""
GRIPPER_SECONDS = 0.5
"""Time of a full gripper stroke, as a UFACTORY gripper at a middling speed."""
STIFFNESS = 600.0
"""Operational-space kp: the arm lags a moving target by 2/√kp ≈ 80 ms."""


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """What a view needs to draw one moment of the twin."""

    qpos: Float[np.ndarray, "nq"]
    body_pos: Float[np.ndarray, "nbody 3"]
    body_quat: Float[np.ndarray, "nbody 4"]


def quat_wxyz_to_xyzw(q: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4"]:
    """MuJoCo's quaternion order to ours."""
    return np.array([q[1], q[2], q[3], q[0]])


def make_environment(task: TaskConfig, robot: str) -> Any:
    """robosuite's environment for the task, without cameras or a renderer of its own."""
    logging.disable(logging.WARNING)  # robosuite warns at import of optional parts this program does not use
    try:
        import robosuite
        from robosuite.utils.placement_samplers import UniformRandomSampler
    finally:
        logging.disable(logging.NOTSET)
    logging.getLogger("robosuite_logs").setLevel(logging.ERROR)
    chosen = {}
    if task.placement is not None:
        dx, dy = task.placement
        chosen["placement_initializer"] = UniformRandomSampler(
            name="ObjectSampler", x_range=[-dx, dx], y_range=[-dy, dy], rotation=None,
            ensure_object_boundary_in_range=False, ensure_valid_placement=True,
            reference_pos=np.array((0.0, 0.0, 0.8)), z_offset=0.01,
        )  # fmt: skip
    return robosuite.make(
        task.environment, robots=robot, has_renderer=False, has_offscreen_renderer=False, use_camera_obs=False,
        reward_shaping=True, initialization_noise=None, hard_reset=False, horizon=10**9, control_freq=SERVO_HZ,
        seed=0,  # Lift draws its cube's size when it is made: every twin of a task must be the same
        **chosen,
    )  # fmt: skip


def seed_placements(sampler: Any, rng: np.random.Generator) -> None:
    """Let a placement sampler, and those it is made of, draw from this generator."""
    sampler.rng = rng
    for part in getattr(sampler, "samplers", {}).values():
        seed_placements(part, rng)


class TwinPlant:
    """A Plant (hw/plant.py) in simulated time: `advance` is what lets time pass."""

    servo_hz = SERVO_HZ
    guided = False

    def __init__(self, rig: RigConfig, task: TaskConfig) -> None:
        self.rig, self.task = rig, task
        self.arm = ARMS[rig.arm]
        self.env = make_environment(task, self.arm.robot)
        self._bind()
        self._grip = -1.0
        self._grip_target = -1.0
        self._ticks = 0
        self._task_check: tuple[bool, float] = (False, 0.0)
        self._policy_tick = max(1, round(SERVO_HZ / task.rate))
        self.reset(0)

    def _bind(self) -> None:
        """Indices into the simulation (robosuite rebuilds its simulation only on a hard reset)."""
        self.model = self.env.sim.model._model
        self.data = self.env.sim.data._data
        self.model.opt.timestep = 1.0 / (SERVO_HZ * SUBSTEPS)
        self.model.joint("robot0_joint4").range[1] = self.arm.elbow_stop
        self.robot = self.env.robots[0]
        arm = self.robot.arms[0]
        self._site = self.robot.eef_site_id[arm]
        self._arm_qpos = np.asarray(self.robot._ref_joint_pos_indexes[:7])
        self._finger_qpos = np.array([self.model.joint(name).qposadr[0] for name, _, _ in self.arm.finger_joints])
        self._shut, self._wide = np.array([(shut, wide) for _, shut, wide in self.arm.finger_joints]).T
        self._arm_actuators = np.array([self.model.actuator(f"robot0_torq_j{i}").id for i in range(1, 8)])
        dofs = np.array([self.model.joint(f"robot0_joint{i}").dofadr[0] for i in range(1, 8)])
        mujoco.mj_forward(self.model, self.data)
        self.osc = OperationalSpace(self.model, self.data, self._site, dofs, self._arm_qpos, STIFFNESS)
        self._fingers = [self._finger(self.model.actuator(name).id, opens_low) for name, opens_low in self.arm.fingers]
        base = self.model.body("robot0_base").id
        if self.rig.base:
            self.model.body_pos[base] = self.rig.base
            mujoco.mj_forward(self.model, self.data)
        self._base_position = self.data.xpos[base].copy()
        self._base_quaternion = quat_wxyz_to_xyzw(self.data.xquat[base])
        self._base_inverse = quat_inverse(self._base_quaternion)
        self._base_rotation = self.data.xmat[base].reshape(3, 3).copy()
        self._objects = {name: self._place_of(element) for name, element in self.task.objects}

    def _finger(self, actuator: int, opens_low: bool) -> tuple[int, float, float]:
        """(actuator, its control where the hand is open, where it is closed)."""
        low, high = self.model.actuator_ctrlrange[actuator].tolist()
        return (actuator, low, high) if opens_low else (actuator, high, low)

    def _place_of(self, element: str) -> tuple[np.ndarray, np.ndarray]:
        """World position and rotation matrix of a body or site, as views that follow the simulation."""
        if mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, element) >= 0:
            body = self.model.body(element).id
            return self.data.xpos[body], self.data.xmat[body]
        site = self.model.site(element).id
        return self.data.site_xpos[site], self.data.site_xmat[site]

    def to_base(self, position: Float[np.ndarray, "3"], quaternion: Float[np.ndarray, "4"]) -> Pose:
        """A world pose (xyzw) in the arm's base frame."""
        offset = position - self._base_position
        return Pose(position=offset @ self._base_rotation, quaternion=quat_multiply(self._base_inverse, quaternion))

    def to_world(self, pose: Pose) -> Pose:
        """A base-frame pose in the world."""
        position = self._base_rotation @ pose.position + self._base_position
        return Pose(position=position, quaternion=quat_multiply(self._base_quaternion, pose.quaternion))

    def reset(self, seed: int) -> None:
        seed_placements(self.env.placement_initializer, np.random.default_rng(seed))
        self.env.reset()
        self._bind()
        if self.rig.start_joints:
            self.data.qpos[self._arm_qpos] = self.rig.start_joints
        self.osc.posture = self.data.qpos[self._arm_qpos].copy()
        self._settle()

    def free(self) -> None:
        self.data.qpos[self._arm_qpos] = self.osc.posture
        self.data.qpos[self._finger_qpos] = self._wide
        self._settle()

    def _settle(self) -> None:
        """At rest where it stands, hand open: objects settle on the table, the arm takes its weight."""
        self.data.qvel[:] = 0.0
        mujoco.mj_forward(self.model, self.data)
        self._grip = self._grip_target = -1.0
        self.servo(self.measure().eef, -1.0)
        for _ in range(SERVO_HZ // 4):
            self.advance()
        self._ticks = 0

    def measure(self) -> Measured:
        objects = {name: self._pose(*place) for name, place in self._objects.items()}
        success, reward = self._task_check
        opening = (self.data.qpos[self._finger_qpos] - self._shut) / (self._wide - self._shut)
        return Measured(
            eef=self._pose(self.data.site_xpos[self._site], self.data.site_xmat[self._site]),
            joints=self.data.qpos[self._arm_qpos].copy(),
            gripper=float(np.clip(opening.mean(), 0.0, 1.0)),
            objects=objects, success=success, reward=reward,
        )  # fmt: skip

    def _pose(self, position: Float[np.ndarray, "3"], matrix: Float[np.ndarray, "9"]) -> Pose:
        """Base frame."""
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, matrix)
        return self.to_base(position, quat_wxyz_to_xyzw(quaternion))

    def servo(self, pose: Pose, gripper: float) -> None:
        self.osc.aim(self.to_world(pose))
        self._grip_target = max(-1.0, min(1.0, gripper))

    def advance(self) -> None:
        reach = 2.0 / (GRIPPER_SECONDS * SERVO_HZ)
        self._grip += max(-reach, min(reach, self._grip_target - self._grip))
        closed = (self._grip + 1.0) / 2.0
        model, data, control = self.model, self.data, self.data.ctrl
        for finger, opened, shut in self._fingers:
            control[finger] = opened + closed * (shut - opened)
        for i in range(SUBSTEPS):
            mujoco.mj_step1(model, data)
            if i == 0:
                self.osc.refresh()
            control[self._arm_actuators] = self.osc.torques()
            mujoco.mj_step2(model, data)
        self._ticks += 1
        if self._ticks % self._policy_tick == 0:
            self._task_check = (bool(self.env._check_success()), float(self.env.reward(None)))

    def halt(self) -> None: ...

    def guide(self, on: bool) -> None:
        if on:
            raise RobotError("the twin cannot be led by hand: steer it (--teleop), or give --robot xarm")

    def rearm(self) -> bool:
        return False

    def close(self) -> None: ...

    def snapshot(self) -> Snapshot:
        return Snapshot(
            qpos=self.data.qpos.copy(), body_pos=self.model.body_pos.copy(), body_quat=self.model.body_quat.copy()
        )

    def model_xml(self) -> str:
        """The scene as MJCF, for a view's own model."""
        return self.env.model.get_xml()

    def cameras(self) -> dict[str, CameraPlacement]:
        """Where the cameras are, by name."""
        position, target = self.task.front
        front = CameraPlacement(position=position, target=target, up=(0, 0, 1), fovy=48.0)
        return {"front": front, "wrist": self.arm.wrist}

    def base_pose(self) -> Pose:
        """The arm's base in the world."""
        return Pose(position=self._base_position.copy(), quaternion=self._base_quaternion.copy())
