"""The twin: a robosuite xArm7 as a plant the controller moves at 120 Hz, in simulated time.

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
from far_app.motion import quat_inverse, quat_multiply
from far_app.types import Pose
from hw.osc import OperationalSpace
from hw.plant import Measured
from hw.rig import RigConfig

SERVO_HZ = 120
SUBSTEPS = 4
"""Physics steps a servo tick: 1/480 s each."""
GRIPPER_SECONDS = 0.5
"""Time of a full gripper stroke, as a UFACTORY gripper at a middling speed."""
GRIPPER_CLOSED = 0.85
"""Driver joint of the xArm gripper when closed, radians."""
STIFFNESS = 600.0
"""Operational-space kp: the arm lags a moving target by 2/√kp ≈ 80 ms."""


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """What a view needs to draw one moment of the twin."""

    qpos: Float[np.ndarray, "nq"]


def quat_wxyz_to_xyzw(q: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4"]:
    """MuJoCo's quaternion order to ours."""
    return np.array([q[1], q[2], q[3], q[0]])


def make_environment(task: TaskConfig) -> Any:
    """robosuite's environment for the task, without cameras or a renderer of its own."""
    logging.disable(logging.WARNING)  # robosuite warns at import of optional parts this program does not use
    try:
        import robosuite
        from robosuite.utils.placement_samplers import UniformRandomSampler
    finally:
        logging.disable(logging.NOTSET)
    logging.getLogger("robosuite_logs").setLevel(logging.ERROR)
    dx, dy = task.placement
    placement = UniformRandomSampler(
        name="ObjectSampler", x_range=[-dx, dx], y_range=[-dy, dy], rotation=None,
        ensure_object_boundary_in_range=False, ensure_valid_placement=True,
        reference_pos=np.array((0.0, 0.0, 0.8)), z_offset=0.01,
    )  # fmt: skip
    return robosuite.make(
        task.environment, robots="XArm7", placement_initializer=placement,
        has_renderer=False, has_offscreen_renderer=False, use_camera_obs=False, reward_shaping=True,
        initialization_noise=None, hard_reset=False, horizon=10**9, control_freq=SERVO_HZ,
    )  # fmt: skip


class TwinPlant:
    """A Plant (hw/plant.py) in simulated time: `advance` is what lets time pass."""

    servo_hz = SERVO_HZ

    def __init__(self, rig: RigConfig, task: TaskConfig) -> None:
        self.rig, self.task = rig, task
        self.env = make_environment(task)
        self._bind()
        self._grip = -1.0
        self._grip_target = -1.0
        self._ticks = 0
        self._task_check: tuple[bool, float] = (False, 0.0)
        self.reset(0)

    def _bind(self) -> None:
        """Indices into the simulation (robosuite rebuilds its simulation only on a hard reset)."""
        self.model = self.env.sim.model._model
        self.data = self.env.sim.data._data
        self.model.opt.timestep = 1.0 / (SERVO_HZ * SUBSTEPS)
        self.robot = self.env.robots[0]
        arm = self.robot.arms[0]
        self._site = self.robot.eef_site_id[arm]
        self._arm_qpos = np.asarray(self.robot._ref_joint_pos_indexes[:7])
        self._driver_qpos = self.model.joint("gripper0_right_left_driver_joint").qposadr[0]
        self._arm_actuators = np.array([self.model.actuator(f"robot0_torq_j{i}").id for i in range(1, 8)])
        dofs = np.array([self.model.joint(f"robot0_joint{i}").dofadr[0] for i in range(1, 8)])
        mujoco.mj_forward(self.model, self.data)
        self.osc = OperationalSpace(self.model, self.data, self._site, dofs, self._arm_qpos, STIFFNESS)
        self._finger_actuator = self.model.actuator("gripper0_right_fingers_actuator").id
        base = self.model.body("robot0_base").id
        self._base_position = self.data.xpos[base].copy()
        self._base_quaternion = quat_wxyz_to_xyzw(self.data.xquat[base])
        self._objects = {o.name: self.model.body(o.root_body).id for o in self.env.model.mujoco_objects}

    def to_base(self, position: Float[np.ndarray, "3"], quaternion: Float[np.ndarray, "4"]) -> Pose:
        """A world pose (xyzw) in the arm's base frame."""
        inverse, offset = quat_inverse(self._base_quaternion), np.append(position - self._base_position, 0.0)
        rotated = quat_multiply(quat_multiply(inverse, offset), self._base_quaternion)
        return Pose(position=rotated[:3], quaternion=quat_multiply(inverse, quaternion))

    def to_world(self, pose: Pose) -> Pose:
        """A base-frame pose in the world."""
        q = self._base_quaternion
        rotated = quat_multiply(quat_multiply(q, np.append(pose.position, 0.0)), quat_inverse(q))
        return Pose(position=rotated[:3] + self._base_position, quaternion=quat_multiply(q, pose.quaternion))

    def reset(self, seed: int) -> None:
        self.env.placement_initializer.rng = np.random.default_rng(seed)
        self.env.reset()
        self._bind()
        if self.rig.start_joints:
            self.data.qpos[self._arm_qpos] = self.rig.start_joints
        self.data.qvel[:] = 0.0
        mujoco.mj_forward(self.model, self.data)
        self._grip = self._grip_target = -1.0
        self.osc.posture = self.data.qpos[self._arm_qpos].copy()
        measured = self.measure()
        self.servo(measured.eef, -1.0)
        for _ in range(SERVO_HZ // 4):
            self.advance()  # objects settle on the table, the arm takes its weight
        self._ticks = 0

    def measure(self) -> Measured:
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, self.data.site_xmat[self._site])
        objects = {
            name: self.to_base(self.data.xpos[body].copy(), quat_wxyz_to_xyzw(self.data.xquat[body]))
            for name, body in self._objects.items()
        }
        success, reward = self._task_check
        return Measured(
            eef=self.to_base(self.data.site_xpos[self._site].copy(), quat_wxyz_to_xyzw(quaternion)),
            joints=self.data.qpos[self._arm_qpos].copy(),
            gripper=float(np.clip(1.0 - self.data.qpos[self._driver_qpos] / GRIPPER_CLOSED, 0.0, 1.0)),
            objects=objects, success=success, reward=reward,
        )  # fmt: skip

    def servo(self, pose: Pose, gripper: float) -> None:
        self.osc.aim(self.to_world(pose))
        self._grip_target = float(np.clip(gripper, -1.0, 1.0))

    def advance(self) -> None:
        reach = 2.0 / (GRIPPER_SECONDS * SERVO_HZ)
        self._grip += float(np.clip(self._grip_target - self._grip, -reach, reach))
        low, high = self.model.actuator_ctrlrange[self._finger_actuator]
        self.data.ctrl[self._finger_actuator] = low + (self._grip + 1.0) / 2.0 * (high - low)
        for i in range(SUBSTEPS):
            mujoco.mj_step1(self.model, self.data)
            if i == 0:
                self.osc.refresh()
            self.data.ctrl[self._arm_actuators] = self.osc.torques()
            mujoco.mj_step2(self.model, self.data)
        self._ticks += 1
        if self._ticks % (SERVO_HZ // 30) == 0:
            self._task_check = (bool(self.env._check_success()), float(self.env.reward()))

    def snapshot(self) -> Snapshot:
        return Snapshot(qpos=self.data.qpos.copy())

    def model_xml(self) -> str:
        """The scene as MJCF, for a view's own model."""
        return self.env.model.get_xml()

    def base_pose(self) -> Pose:
        """The arm's base in the world."""
        return Pose(position=self._base_position.copy(), quaternion=self._base_quaternion.copy())
