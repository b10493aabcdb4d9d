"""From a policy's delta to an absolute target and back; one function, shared by twin and arm.

    p_{t+1} = p_t + s_p · a[0:3]          R_{t+1} = exp(s_r · a[3:6]) R_t          (base frame)

p_t, R_t are the last *sent* pose, never further than the leash from the measured one.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from far_app.types import ACTION_DIM, Ack, Pose, Target


@dataclass(frozen=True, kw_only=True)
class ActionScale:
    """Rig data: what ±1 means, a tick."""

    translation: float = 0.008
    """Metres a tick at ±1."""
    rotation: float = 0.05
    """Radians a tick at ±1."""
    leash_translation: float = 0.06
    """Largest distance between a new target and the measured position, metres."""
    leash_rotation: float = 0.5
    """Largest angle between a new target and the measured orientation, radians."""
    expiry: float = 0.1
    """Seconds a target stays valid."""

    def repeated(self, times: int) -> ActionScale:
        """What ±1 means where each action is repeated for so many control steps."""
        return replace(self, translation=times * self.translation, rotation=times * self.rotation)


def quat_multiply(a: Float[np.ndarray, "4"], b: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4"]:
    """Rotation a after b, xyzw."""
    ax, ay, az, aw = a.tolist()  # Python floats: four times faster than numpy's scalars
    bx, by, bz, bw = b.tolist()
    return np.array([
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    ])  # fmt: skip


def quat_inverse(q: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4"]:
    """The inverse of a unit quaternion, xyzw."""
    return np.array([-q[0], -q[1], -q[2], q[3]])


def quat_from_rotvec(v: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4"]:
    """exp of a rotation vector (radians), xyzw."""
    x, y, z = v.tolist()
    angle = math.hypot(x, y, z)
    s = 0.5 if angle < 1e-9 else math.sin(angle / 2) / angle
    return np.array([x * s, y * s, z * s, math.cos(angle / 2)])


def rotvec_from_quat(q: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3"]:
    """log of a unit quaternion (xyzw) as a rotation vector of length ≤ π, radians."""
    q = q if q[3] >= 0 else -q
    x, y, z, w = q.tolist()
    n = math.hypot(x, y, z)
    return q[:3] * (2.0 if n < 1e-9 else 2.0 * math.atan2(n, w) / n)


def rotation_between(a: Float[np.ndarray, "4"], b: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3"]:
    """The base-frame rotation vector that turns orientation a into b."""
    return rotvec_from_quat(quat_multiply(b, quat_inverse(a)))


def integrate(last_sent: Pose, measured: Pose, action: Float[np.ndarray, "A"], scale: ActionScale) -> Pose:
    """The absolute target of one action, from the last sent pose, on a leash to the measured one."""
    position = last_sent.position + scale.translation * action[0:3]
    offset = position - measured.position
    distance = float(np.linalg.norm(offset))
    if distance > scale.leash_translation:
        position = measured.position + offset * (scale.leash_translation / distance)
    quaternion = quat_multiply(quat_from_rotvec(scale.rotation * action[3:6]), last_sent.quaternion)
    turn = rotation_between(measured.quaternion, quaternion)
    angle = float(np.linalg.norm(turn))
    if angle > scale.leash_rotation:
        quaternion = quat_multiply(quat_from_rotvec(turn * (scale.leash_rotation / angle)), measured.quaternion)
    return Pose(position=position, quaternion=quaternion / np.linalg.norm(quaternion))


def action_between(before: Pose, after: Pose, gripper: float, scale: ActionScale) -> Float[np.ndarray, "A"]:
    """The action that leads from one sent pose to the next: the inverse of integrate without its leash."""
    action = np.empty(ACTION_DIM)
    action[0:3] = (after.position - before.position) / scale.translation
    action[3:6] = rotation_between(before.quaternion, after.quaternion) / scale.rotation
    action[6] = gripper
    return action


class TargetIntegrator:
    """Turns an attempt's actions into targets and its acknowledgments back into executed actions.

    Starts from the measured pose, follows what was *sent*: an acknowledgment replaces our own guess of it.
    """

    _seq = itertools.count(1)

    def __init__(self, scale: ActionScale, measured: Pose) -> None:
        self.scale = scale
        self._sent = measured
        self._origin: dict[int, Pose] = {}
        """Pose each unacknowledged target started from, by sequence number."""

    def target(self, action: Float[np.ndarray, "A"], measured: Pose, due: float) -> Target:
        """The next target, of the tick with deadline due (seconds on the robot's clock); valid for scale.expiry
        from then on."""
        pose = integrate(self._sent, measured, action, self.scale)
        seq = next(self._seq)
        self._origin[seq] = self._sent
        self._sent = pose
        return Target(
            seq=seq, pose=pose, gripper=float(action[6]), created=due, expires=due + self.scale.expiry, due=due
        )

    def executed(self, ack: Ack) -> Float[np.ndarray, "A"] | None:
        """ã of an acknowledged target, or None for a target that is not ours or was refused."""
        origin = self._origin.pop(ack.seq, None)
        if origin is None or ack.refused:
            return None
        if not self._origin:
            self._sent = ack.pose
        return action_between(origin, ack.pose, ack.gripper, self.scale)
