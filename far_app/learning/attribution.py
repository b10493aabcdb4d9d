"""Which chunks of a failed attempt are to blame (paper, Failure Attribution).

    ΔV_t = V(s_{t+H}) − V(s_t)                 τ⁻ = { t | ΔV_t ≤ Percentile_ρ({ΔV_j}) }

Only whole chunks (t + H ≤ T) are ranked. Pure numpy; the methods call it after each failure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from far_app.config import AttributionConfig
from far_app.errors import ConfigError
from far_app.types import FlagCorrection


@dataclass(frozen=True, kw_only=True)
class Flags:
    ticks: tuple[int, ...]
    """Ticks at which flagged chunks begin, in time order."""
    threshold: float
    """ΔV at or below which a chunk was flagged; NaN when there was nothing to rank."""


def value_change(values: Float[np.ndarray, "T+1"], horizon: int) -> Float[np.ndarray, "T+1-H"]:
    """ΔV_t of every whole chunk of an attempt, values being V(s_0) … V(s_T). Same unit as V; negative where the chunk
    made things worse; NaN where a value is missing; empty when the attempt is shorter than a chunk."""
    if len(values) <= horizon:
        return np.zeros(0)
    return values[horizon:] - values[:-horizon]


def without_person(
    changes: Float[np.ndarray, "C"], person: Bool[np.ndarray, "T"], horizon: int
) -> Float[np.ndarray, "C"]:
    """ΔV with NaN for every chunk in which a person moved the arm at some tick: nothing to blame the policy for."""
    theirs = [bool(person[t : t + horizon].any()) for t in range(len(changes))]
    return np.where(theirs, np.nan, changes) if theirs else changes


def flag(changes: Float[np.ndarray, "C"], config: AttributionConfig) -> Flags:
    """The chunks to learn from. An unknown ΔV (NaN) is never flagged."""
    known = np.isfinite(changes)
    if not known.any():
        return Flags(ticks=(), threshold=math.nan)
    if config.rule == "threshold" and math.isnan(config.threshold):
        raise ConfigError(
            "attribution.rule is threshold but attribution.threshold is nan; set it to a value change, for example a "
            "low percentile of the demonstrations' own"
        )
    threshold = {
        "percentile": lambda: float(np.percentile(changes[known], config.rho)),
        "threshold": lambda: config.threshold,
        "whole": lambda: float(changes[known].max()),
    }[config.rule]()
    return Flags(ticks=tuple(int(t) for t in np.flatnonzero(known & (changes <= threshold))), threshold=threshold)


def corrected(ticks: Sequence[int], corrections: Sequence[FlagCorrection], chunks: int) -> tuple[int, ...]:
    """The flagged ticks with the operator's words: the last on a tick counts; one on no whole chunk says nothing."""
    flagged = set(ticks)
    for correction in corrections:
        if 0 <= correction.tick < chunks:
            (flagged.add if correction.flagged else flagged.discard)(correction.tick)
    return tuple(sorted(flagged))
