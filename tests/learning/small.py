"""A policy, a critic and an attempt small enough for unit tests, made of the real classes."""

import numpy as np
import torch

from far_app.learning.critic import Critic, CriticShape
from far_app.learning.policy import DiffusionPolicy, PolicyConfig
from far_app.types import ACTION_DIM, Attempt, Judge, Observation, Outcome, Pose, RobotMode, RobotStatus, Step

SIZE = 16


def small_policy(seed: int = 0) -> DiffusionPolicy:
    torch.manual_seed(seed)
    config = PolicyConfig(preset="test", task="lift", encoder="light", image_size=SIZE, widths=(16, 32), ddim_steps=4)
    return DiffusionPolicy(config).eval().requires_grad_(False)


def small_critic(policy: DiffusionPolicy, seed: int = 1) -> Critic:
    torch.manual_seed(seed)
    shape = CriticShape(features=policy.feature_dim, horizon=policy.config.horizon, action_dim=ACTION_DIM, hidden=(16,))
    return Critic(shape).eval().requires_grad_(False)


def observation(seq: int, rng: np.random.Generator) -> Observation:
    images = {c: rng.integers(0, 256, (SIZE, SIZE, 3), dtype=np.uint8) for c in ("front", "wrist")}
    pose = Pose(position=rng.uniform(-1, 1, 3), quaternion=np.array([0.0, 1.0, 0.0, 0.0]))
    return Observation(
        seq=seq, stamp=seq / 30, eef=pose, gripper=float(rng.random()), joints=np.zeros(7), images=images,
        status=RobotStatus(mode=RobotMode.TRACKING),
    )  # fmt: skip


def small_attempt(ticks: int = 40, index: int = 1, scene_seed: int = 5, values: bool = True) -> Attempt:
    """A failed attempt with random pictures and actions; V recorded in every tick, or in none."""
    rng = np.random.default_rng([scene_seed, index])
    steps = []
    for t in range(ticks):
        action = np.clip(rng.normal(scale=0.4, size=ACTION_DIM), -1, 1)
        steps.append(Step(
            tick=t, seq=t, stamp=t / 30, deadline=t / 30, observation=observation(t, rng), action=action,
            perturbation=np.zeros(ACTION_DIM), commanded=action, sent=action, chunk_tick=t, starved=False,
            policy_version="base", value=float(rng.normal()) if values else float("nan"), reward=0.0, success=False,
        ))  # fmt: skip
    return Attempt(
        index=index, scene_seed=scene_seed, steps=tuple(steps), final=observation(ticks, rng),
        outcome=Outcome(success=False, judged_by=Judge.HORIZON), policy_version="base",
    )  # fmt: skip
