"""Scripted experts: what a demonstration does, with enough chance in it that no two are copies.

An expert looks at the twin's object poses and gives the same 7-d actions a policy gives; it acts through the same
robot, safety filter and horizon. A new task's expert is one function of this form.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from far_app.errors import ConfigError
from far_app.motion import ActionScale, quat_from_rotvec, quat_multiply, rotation_between
from far_app.types import ACTION_DIM, Observation, Pose

Expert = Callable[[Observation], Float[np.ndarray, "A"]]
"""The action for this moment. Made anew for each demonstration."""

GAIN = 0.3
"""Share of the remaining distance asked for in a tick; the arm answers with about three ticks' delay."""


@dataclass(frozen=True, kw_only=True)
class Style:
    """One demonstration's own way of doing things."""

    speed: float
    """Largest action component, in (0, 1]."""
    noise: float
    """Standard deviation added to the arm's action."""
    hover: float
    """Height above the object before descending, metres."""
    offset: Float[np.ndarray, "3"]
    """Grasp offset, metres."""
    via: Float[np.ndarray, "2"]
    """Sideways detour of the approach, metres."""
    dwell: int
    """Ticks the gripper takes before the lift."""

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Style:
        return cls(
            speed=rng.uniform(0.7, 1.0), noise=rng.uniform(0.02, 0.10), hover=rng.uniform(0.05, 0.10),
            offset=rng.normal(0.0, (0.003, 0.003, 0.002)), via=rng.uniform(-0.05, 0.05, 2),
            dwell=int(rng.integers(12, 18)),
        )  # fmt: skip


def toward(
    observation: Observation, goal: Pose, gripper: float, style: Style, scale: ActionScale, rng: np.random.Generator
) -> Float[np.ndarray, "A"]:
    """A step toward a pose, limited in speed, with the style's noise on the arm."""
    action = np.empty(ACTION_DIM)
    move = GAIN * (goal.position - observation.eef.position) / scale.translation
    turn = GAIN * rotation_between(observation.eef.quaternion, goal.quaternion) / scale.rotation
    action[:3] = move * min(1.0, style.speed / max(1e-9, float(np.abs(move).max())))
    action[3:6] = np.clip(turn, -style.speed, style.speed)
    action[:6] += rng.normal(0.0, style.noise, 6) * np.array((1, 1, 1, 0.5, 0.5, 0.5))
    action[6] = gripper
    return np.clip(action, -1.0, 1.0)


def square_yaw(quaternion: Float[np.ndarray, "4"]) -> float:
    """Yaw of a cube (xyzw), the equivalent one in [−π/4, π/4)."""
    x, y, z, w = quaternion
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return float((yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4)


def lift(rng: np.random.Generator, scale: ActionScale, start: Pose) -> Expert:
    """Above the cube, turn to its sides, down, close, up."""
    style = Style.draw(rng)
    state = {"phase": "approach", "held": 0}

    def act(observation: Observation) -> Float[np.ndarray, "A"]:
        cube = observation.objects["cube"]
        grasp = cube.position + style.offset
        turned = quat_multiply(quat_from_rotvec(np.array((0, 0, square_yaw(cube.quaternion)))), start.quaternion)
        above = grasp + (0.0, 0.0, style.hover)
        distance = float(np.linalg.norm((above - observation.eef.position)[:2]))
        if state["phase"] == "approach":
            detour = np.append(style.via * min(1.0, distance / 0.10), 0.0)
            if distance < 0.008 and np.linalg.norm(rotation_between(observation.eef.quaternion, turned)) < 0.12:
                state["phase"] = "descend"
            return toward(observation, Pose(position=above + detour, quaternion=turned), -1.0, style, scale, rng)
        if state["phase"] == "descend":
            if observation.eef.position[2] - grasp[2] < 0.006:
                state["phase"] = "close"
            elif distance > 0.03:
                state["phase"] = "approach"
            return toward(observation, Pose(position=grasp, quaternion=turned), -1.0, style, scale, rng)
        if state["phase"] == "close":
            state["held"] += 1
            if state["held"] >= style.dwell:
                state["phase"] = "lift"
            return toward(observation, Pose(position=grasp, quaternion=turned), 1.0, style, scale, rng)
        if observation.gripper < 0.15:  # closed on nothing
            state.update(phase="approach", held=0)
        up = observation.eef.position + (0.0, 0.0, 0.05)
        return toward(observation, Pose(position=up, quaternion=turned), 1.0, style, scale, rng)

    return act


EXPERTS = {"lift": lift}


def expert(task: str, rng: np.random.Generator, scale: ActionScale, start: Pose) -> Expert:
    """A fresh expert for one demonstration of the task."""
    if task not in EXPERTS:
        raise ConfigError(f"no scripted expert for task '{task}'; there is one for: {', '.join(sorted(EXPERTS))}")
    return EXPERTS[task](rng, scale, start)
