"""Demonstrations by a scripted expert, through the same robot, safety filter and horizon as any policy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from far_app.config import TaskConfig
from far_app.experts import expert
from far_app.motion import ActionScale, TargetIntegrator
from far_app.protocols import Heartbeat, Home, Reset, Robot
from far_app.types import Observation

SEED_OFFSET = 1_000_000
"""Demonstrations use scene seeds from here on, so that no reporting scene is ever a training scene."""


def demonstrate(
    robot: Robot, advance: Callable[[], float], task: TaskConfig, scale: ActionScale, seed: int
) -> tuple[list[Observation], list[np.ndarray], bool]:
    """One attempt of the task's expert on scene `seed`: what it saw, what it did, and whether it succeeded."""
    robot.request(Reset(seed=seed))
    robot.request(Home())
    now = advance()
    while not robot.observe().status.at_home:
        robot.request(Heartbeat())
        now = advance()
    observation = robot.observe()
    act = expert(task, np.random.default_rng(seed), scale, observation.eef)
    integrator = TargetIntegrator(scale, observation.eef)
    observations: list[Observation] = []
    actions: list[np.ndarray] = []
    held = 0
    for _ in range(task.horizon):
        action = act(observation)
        robot.send(integrator.target(action, observation.eef, now))
        observations.append(observation)
        actions.append(action)
        now = advance()
        observation = robot.observe()
        for ack in observation.acks:
            integrator.executed(ack)
        held = held + 1 if observation.success else 0
        if held >= task.success_ticks:
            return observations, actions, True
    return observations, actions, False
