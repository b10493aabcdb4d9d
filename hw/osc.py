"""Operational-space impedance for the twin's arm (Khatib 1987), the law robosuite uses, in a tenth of the time.

    τ = Jᵀ Λ (k_p e − k_d ẋ) + h + (I − Jᵀ J̄ᵀ) M (k_n (q₀ − q) − k_dn q̇),   Λ = (J M⁻¹ Jᵀ + damping)⁻¹,  J̄ = M⁻¹ Jᵀ Λ

e is the pose error in the world frame, h MuJoCo's bias force, q₀ the posture the elbow is drawn to. A joint that the
hand's task pushes against its end stop does not take part (its column of J is zero): the others then still bring the
hand to its pose, where the whole law would lean on the stop and stand still beside it.
"""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from far_app.motion import rotvec_from_quat
from far_app.types import Pose

DAMPING = 1e-2 * np.eye(6)
"""Keeps Λ, and so the torques, finite where the arm is stretched out."""
AT_STOP = 0.01
"""Radians from its end stop at which a joint counts as there."""


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
        self.goal_position: Float[np.ndarray, "3"] = data.site_xpos[site].copy()
        self.goal_quaternion = self._site_quaternion()
        joints = model.dof_jntid[dofs]
        limited = model.jnt_limited[joints].astype(bool)
        self._low = np.where(limited, model.jnt_range[joints, 0], -np.inf)
        self._high = np.where(limited, model.jnt_range[joints, 1], np.inf)
        self.stopped: Bool[np.ndarray, "7"] = np.zeros(len(dofs), bool)
        self._jacobian = np.zeros((6, model.nv))
        self._mass = np.zeros((model.nv, model.nv))

    def _site_quaternion(self) -> Float[np.ndarray, "4"]:
        """wxyz."""
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, self.data.site_xmat[self.site])
        return quaternion

    def aim(self, world: Pose) -> None:
        """Where to hold from now on."""
        x, y, z, w = world.quaternion
        self.goal_position, self.goal_quaternion = world.position, np.array((w, x, y, z))

    def refresh(self) -> None:
        """Jacobian, mass matrix and what follows from them, at the present configuration."""
        mujoco.mj_jacSite(self.model, self.data, self._jacobian[:3], self._jacobian[3:], self.site)
        mujoco.mj_fullM(self.model, self._mass, self.data.qM)
        self.J = self._jacobian[:, self.dofs]  # (6, 7)
        self.M = self._mass[np.ix_(self.dofs, self.dofs)]  # (7, 7)
        self._derive()
        self.stopped = stopped = self._stopped()
        if stopped.any():
            self.J = np.where(stopped, 0.0, self.J)
            self.M = np.where(np.outer(~stopped, ~stopped), self.M, np.diag(np.diag(self.M)))
            self._derive()

    def _derive(self) -> None:
        """Λ and what takes a wrench and a posture to torques, from J and M."""
        minv_jt = np.linalg.solve(self.M, self.J.T)  # (7, 6)
        inertia = np.linalg.inv(self.J @ minv_jt + DAMPING)  # Λ (6, 6)
        self.gain = self.J.T @ inertia  # (7, 6)
        self.nullspace = (np.eye(len(self.dofs)) - self.gain @ minv_jt.T) @ self.M  # (7, 7)

    def _stopped(self) -> Bool[np.ndarray, "7"]:
        """Joints at an end stop that the hand's error pushes further."""
        q = self.data.qpos[self.qpos]
        at_low, at_high = q < self._low + AT_STOP, q > self._high - AT_STOP
        if not (at_low | at_high).any():
            return at_low
        push = self.gain @ (self.kp * self._error())
        return (at_low & (push < 0.0)) | (at_high & (push > 0.0))

    def _error(self) -> Float[np.ndarray, "6"]:
        """Of the hand's pose, world frame."""
        current = self._site_quaternion()
        current[1:] *= -1.0
        turn = np.empty(4)
        mujoco.mju_mulQuat(turn, self.goal_quaternion, current)
        error = np.empty(6)
        error[:3] = self.goal_position - self.data.site_xpos[self.site]
        error[3:] = rotvec_from_quat(turn[[1, 2, 3, 0]])
        return error

    def torques(self) -> Float[np.ndarray, "7"]:
        """τ for the coming physics step."""
        velocity = self.data.qvel[self.dofs]
        wrench = self.kp * self._error() - self.kd * (self.J @ velocity)
        away = np.where(self.stopped, 0.0, self.posture - self.data.qpos[self.qpos])
        posture = self.kn * away - self.kdn * velocity
        return self.gain @ wrench + self.nullspace @ posture + self.data.qfrc_bias[self.dofs]
