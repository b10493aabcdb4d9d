"""Operational-space impedance for the twin's arm (Khatib 1987), the law robosuite uses, in a tenth of the time.

    τ = Jᵀ Λ (k_p e − k_d ẋ) + h + (I − Jᵀ J̄ᵀ) M (k_n (q₀ − q) − k_dn q̇),   Λ = (J M⁻¹ Jᵀ + damping)⁻¹,  J̄ = M⁻¹ Jᵀ Λ

e is the pose error in the world frame, h MuJoCo's bias force, q₀ the posture the elbow is drawn to. A joint that the
hand's task pushes against its end stop does not take part (its column of J is zero): the others then still bring the
hand to its pose, where the whole law would lean on the stop and stand still beside it.

The arithmetic is compiled (once, when first imported on a machine): it runs at every physics step.
"""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from far_app.types import Pose

DAMPING = 1e-2
"""Keeps Λ, and so the torques, finite where the arm is stretched out."""
AT_STOP = 0.01
"""Radians from its end stop at which a joint counts as there."""
COMPILED = {"cache": True, "nogil": True, "error_model": "numpy"}
Q = "f8[::1]"
MATRIX = "f8[:,::1]"


@njit(f"void({Q}, {Q}, {Q}, {Q}, {Q})", **COMPILED)
def pose_error(goal, turned, position, matrix, out):  # noqa: ANN001, ANN201
    """e: from a site's pose (position; rotation matrix, 9 entries) to the goal's (position; quaternion, wxyz)."""
    for i in range(3):
        out[i] = goal[i] - position[i]
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = matrix
    if m00 + m11 + m22 > 0.0:  # the largest of the four decides, so that nothing is divided by little
        w, x, y, z = 1.0 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01
    elif m00 > m11 and m00 > m22:
        w, x, y, z = m21 - m12, 1.0 + m00 - m11 - m22, m01 + m10, m02 + m20
    elif m11 > m22:
        w, x, y, z = m02 - m20, m01 + m10, 1.0 - m00 + m11 - m22, m12 + m21
    else:
        w, x, y, z = m10 - m01, m02 + m20, m12 + m21, 1.0 - m00 - m11 + m22
    length = np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / length, -x / length, -y / length, -z / length
    a, b, c, d = turned
    ew, ex = a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y
    ey, ez = a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w
    if ew < 0.0:
        ew, ex, ey, ez = -ew, -ex, -ey, -ez
    sine = np.sqrt(ex * ex + ey * ey + ez * ez)
    scale = 2.0 if sine < 1e-9 else 2.0 * np.arctan2(sine, ew) / sine
    out[3], out[4], out[5] = scale * ex, scale * ey, scale * ez


@njit(f"void({MATRIX}, {MATRIX}, {MATRIX}, {MATRIX})", **COMPILED)
def derive(jacobian, mass, gain, nullspace):  # noqa: ANN001, ANN201
    """From J (6, 7) and M (7, 7): Jᵀ Λ (7, 6), which takes a wrench to torques, and (I − Jᵀ J̄ᵀ) M (7, 7), which takes a
    posture's."""
    minv_jt = np.linalg.solve(mass, np.ascontiguousarray(jacobian.T))
    weight = jacobian @ minv_jt
    for i in range(6):
        weight[i, i] += DAMPING
    gain[:] = np.ascontiguousarray(jacobian.T) @ np.linalg.inv(weight)
    rest = -(gain @ np.ascontiguousarray(minv_jt.T))
    for i in range(len(rest)):
        rest[i, i] += 1.0
    nullspace[:] = rest @ mass


@njit(f"void({Q}, {Q}, {Q}, {Q}, {MATRIX}, {MATRIX}, {MATRIX}, f8, f8, f8, f8, {Q})", **COMPILED)
def impedance(error, velocity, away, bias, jacobian, gain, nullspace, kp, kd, kn, kdn, torques):  # noqa: ANN001, ANN201, PLR0913
    """τ of the law above, from the hand's error e, q̇ and q₀ − q."""
    joints = len(velocity)
    for j in range(joints):
        torques[j] = bias[j]
    for i in range(6):
        along = 0.0
        for j in range(joints):
            along += jacobian[i, j] * velocity[j]
        wrench = kp * error[i] - kd * along
        for j in range(joints):
            torques[j] += gain[j, i] * wrench
    for i in range(joints):
        pull = kn * away[i] - kdn * velocity[i]
        for j in range(joints):
            torques[j] += nullspace[j, i] * pull


class OperationalSpace:
    """Torques that hold a site at a world pose; matrices are refreshed once a servo tick, errors every physics step."""

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, site: int, dofs: np.ndarray, qpos: np.ndarray,
        stiffness: float, posture_stiffness: float = 10.0,
    ) -> None:  # fmt: skip
        self.model, self.data, self.site, self.dofs, self.qpos = model, data, site, dofs, qpos
        self.kp, self.kd = stiffness, 2.0 * np.sqrt(stiffness)
        self.kn, self.kdn = posture_stiffness, 2.0 * np.sqrt(posture_stiffness)
        self.posture: Float[np.ndarray, "7"] = data.qpos[qpos].copy()
        self._square = np.ix_(dofs, dofs)
        joints = model.dof_jntid[dofs]
        limited = model.jnt_limited[joints].astype(bool)
        self._low = np.where(limited, model.jnt_range[joints, 0], -np.inf)
        self._high = np.where(limited, model.jnt_range[joints, 1], np.inf)
        self.stopped = np.zeros(len(dofs), bool)
        self._position, self._matrix = data.site_xpos[site], data.site_xmat[site]  # views: they follow the simulation
        self._qpos, self._qvel, self._bias = data.qpos, data.qvel, data.qfrc_bias
        self._all = np.zeros((6, model.nv))
        self._mass = np.zeros((model.nv, model.nv))
        self.J, self.M = np.zeros((6, len(dofs))), np.zeros((len(dofs), len(dofs)))
        self.gain, self.nullspace = np.zeros((len(dofs), 6)), np.zeros((len(dofs), len(dofs)))
        self._error, self._torques = np.zeros(6), np.zeros(len(dofs))
        self.goal_position: Float[np.ndarray, "3"] = self._position.copy()
        self.goal_quaternion: Float[np.ndarray, "4"] = np.empty(4)
        """wxyz."""
        mujoco.mju_mat2Quat(self.goal_quaternion, self._matrix)

    def aim(self, world: Pose) -> None:
        """Where to hold from now on."""
        x, y, z, w = world.quaternion
        self.goal_position, self.goal_quaternion = np.ascontiguousarray(world.position), np.array((w, x, y, z))

    def refresh(self) -> None:
        """Jacobian, mass matrix and what follows from them, at the present configuration."""
        mujoco.mj_jacSite(self.model, self.data, self._all[:3], self._all[3:], self.site)
        mujoco.mj_fullM(self.model, self._mass, self.data.qM)
        self.J[:] = self._all[:, self.dofs]
        self.M[:] = self._mass[self._square]
        derive(self.J, self.M, self.gain, self.nullspace)
        self.stopped = self._find_stopped()
        if self.stopped.any():
            self.J[:, self.stopped] = 0.0
            self.M[:] = np.where(np.outer(~self.stopped, ~self.stopped), self.M, np.diag(np.diag(self.M)))
            derive(self.J, self.M, self.gain, self.nullspace)

    def _find_stopped(self) -> Bool[np.ndarray, "7"]:
        """Joints at an end stop that the hand's error pushes further."""
        q = self._qpos[self.qpos]
        at_low, at_high = q < self._low + AT_STOP, q > self._high - AT_STOP
        if not (at_low | at_high).any():
            return at_low
        pose_error(self.goal_position, self.goal_quaternion, self._position, self._matrix, self._error)
        push = self.gain @ (self.kp * self._error)
        return (at_low & (push < 0.0)) | (at_high & (push > 0.0))

    def torques(self) -> Float[np.ndarray, "7"]:
        """τ for the coming physics step; overwritten by the next."""
        pose_error(self.goal_position, self.goal_quaternion, self._position, self._matrix, self._error)
        away = self.posture - self._qpos[self.qpos]
        if self.stopped.any():
            away[self.stopped] = 0.0
        impedance(
            self._error, self._qvel[self.dofs], away, self._bias[self.dofs], self.J, self.gain, self.nullspace,
            self.kp, self.kd, self.kn, self.kdn, self._torques,
        )  # fmt: skip
        return self._torques
