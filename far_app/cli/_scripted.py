"""`--policy test:still` and `test:wander`: policies without a network, for tests of processes and of the loop itself.

They learn nothing and succeed at nothing; a first run on an arm uses them (docs/safety.md).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from far_app.errors import ConfigError
from far_app.protocols import History, Policy, PolicySpec, Progress
from far_app.session.adaptation import unchanged
from far_app.types import ACTION_DIM, ActionChunk, Adaptation, Attempt

HORIZON = 8


class ScriptedPolicy:
    """Still, or small smooth circles; `nan` poisons every chunk from tick 30 on. Plans in 15 ms, like a network."""

    def __init__(self, kind: str) -> None:
        if kind not in ("still", "wander", "nan"):
            raise ConfigError(f"unknown test policy '{kind}'; choose one of: still, wander, nan")
        self.kind, self.version = kind, f"test:{kind}"
        self.spec = PolicySpec(
            name=self.version, task="lift", horizon=HORIZON, n_obs=2, action_dim=ACTION_DIM, cameras=(), image_size=0,
            state_keys=(),
        )  # fmt: skip

    def plan(
        self,
        histories: Sequence[History],
        ticks: Sequence[int],
        noise: Float[np.ndarray, "B H A"],
    ) -> list[ActionChunk]:
        time.sleep(0.015)
        return [ActionChunk(tick=t, actions=self._actions(t), policy_version=self.version, value=-1.0) for t in ticks]

    def _actions(self, tick: int) -> np.ndarray:
        actions = np.zeros((HORIZON, ACTION_DIM))
        actions[:, 6] = -1.0
        if self.kind == "wander":
            phase = 2 * np.pi * (tick + np.arange(HORIZON)) / 60
            actions[:, 0], actions[:, 1] = 0.3 * np.cos(phase), 0.3 * np.sin(phase)
        elif self.kind == "nan" and tick >= 30:
            actions[:] = np.nan
        return actions


class ScriptedMethod:
    """Tries again, unchanged."""

    name = "test"

    def __init__(self, kind: str) -> None:
        self.policy: Policy = ScriptedPolicy(kind)

    def begin(self, scene_seed: int) -> None: ...

    def adapt(self, attempt: Attempt, cancelled: Callable[[], bool], progress: Progress) -> Adaptation:
        return unchanged(self.policy.version, "none")

    def perturb(self, attempt_index: int, scene_seed: int) -> Callable[[int], np.ndarray]:
        return lambda tick: np.zeros(ACTION_DIM)
