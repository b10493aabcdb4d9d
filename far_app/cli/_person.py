"""In a policy's place where a person demonstrates: it plans no motion, and asks for every view the task has."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from far_app.cli.assemble import Parts
from far_app.config import TaskConfig
from far_app.guided import VERSION
from far_app.protocols import OWN_STATE, History, Policy, PolicySpec, Progress
from far_app.session.adaptation import unchanged
from far_app.types import ACTION_DIM, ActionChunk, Adaptation, Attempt

HORIZON = 8


class NoPolicy:
    """far_app.protocols.Policy that leaves the arm where it is, its hand open."""

    version = VERSION

    def __init__(self, task: TaskConfig, image_size: int) -> None:
        self.spec = PolicySpec(
            name=VERSION, task=task.name, horizon=HORIZON, n_obs=1, action_dim=ACTION_DIM, cameras=task.cameras,
            image_size=image_size, state_keys=OWN_STATE,
        )  # fmt: skip

    def plan(
        self, histories: Sequence[History], ticks: Sequence[int], noise: Float[np.ndarray, "B H A"]
    ) -> list[ActionChunk]:
        still = np.append(np.zeros(6), -1.0)
        return [ActionChunk(tick=t, actions=np.tile(still, (HORIZON, 1)), policy_version=VERSION) for t in ticks]


class NoMethod:
    """far_app.protocols.Method: one attempt, nothing learnt."""

    name = VERSION

    def __init__(self, task: TaskConfig, image_size: int) -> None:
        self.policy: Policy = NoPolicy(task, image_size)

    def begin(self, scene_seed: int) -> None: ...

    def adapt(self, attempt: Attempt, cancelled: Callable[[], bool], progress: Progress) -> Adaptation:
        return unchanged(VERSION, "none")

    def perturb(self, attempt_index: int, scene_seed: int) -> Callable[[int], np.ndarray]:
        return lambda tick: np.zeros(ACTION_DIM)


def person_parts(task: TaskConfig, image_size: int) -> Parts:
    """What far_app/cli/stage.py needs where nobody but a person acts."""
    return Parts(
        method=NoMethod(task, image_size), policy_name=VERSION, checkpoint=None, max_attempts=1,
        another=lambda: NoMethod(task, image_size),
    )  # fmt: skip
