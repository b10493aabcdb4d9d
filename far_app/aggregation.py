"""g: one action from overlapping chunks (paper, Conservative Value Estimation; weights as in paper/choices.md)."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from far_app.types import ARM_DIMS, ActionChunk


class Plan:
    """The chunks that still reach into the future of one attempt, indexed by the tick they were computed from.

    â_t is the uniform mean of every chunk's prediction for tick t: at most H of them.
    """

    def __init__(self, horizon: int) -> None:
        self.horizon = horizon
        self._chunks: dict[int, ActionChunk] = {}

    @property
    def newest_tick(self) -> int:
        """Tick of the newest chunk; −1 with none."""
        return max(self._chunks, default=-1)

    def add(self, chunk: ActionChunk) -> None:
        self._chunks[chunk.tick] = chunk

    def action(self, tick: int) -> Float[np.ndarray, "A"] | None:
        """â_t, or None when no chunk reaches tick t: then the arm holds."""
        self._chunks = {k: c for k, c in self._chunks.items() if tick < k + self.horizon}
        predictions = [c.actions[tick - k] for k, c in self._chunks.items() if k <= tick]
        return np.mean(predictions, axis=0) if predictions else None

    def newest(self) -> Plan:
        """The newest chunk alone."""
        plan = Plan(self.horizon)
        if self._chunks:
            plan.add(self._chunks[self.newest_tick])
        return plan

    def spread(self, tick: int) -> float:
        """How far the chunks disagree on tick t: root mean square distance of their arm actions from the mean; NaN with
        fewer than two."""
        reaching = [c.actions[tick - k, :ARM_DIMS] for k, c in self._chunks.items() if k <= tick < k + self.horizon]
        if len(reaching) < 2:
            return math.nan
        actions = np.stack(reaching)
        return float(np.sqrt(((actions - actions.mean(0)) ** 2).sum(1).mean()))

    def value(self, tick: int) -> float:
        """V(s_t) when the chunk of this very tick is here, else NaN."""
        chunk = self._chunks.get(tick)
        return chunk.value if chunk is not None else math.nan
