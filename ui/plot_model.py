"""What the two plots draw: V(s_t) with flagged chunks shaded, ΔV per chunk with its threshold. Pure.

Both share one x axis, the attempt's tick, of fixed length, so that a flagged chunk is found at the same place in both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from far_app.telemetry import Telemetry


@dataclass(frozen=True, kw_only=True)
class ValuePlot:
    """Series over ticks 0 … horizon, all of one length; NaN where there is nothing to draw."""

    tick: Float[np.ndarray, "N"]
    value: Float[np.ndarray, "N"]
    """V(s_t), small gaps bridged."""
    shade: Float[np.ndarray, "N"]
    """1 inside a flagged chunk, 0 elsewhere (never NaN: uPlot shades the wrong region then)."""
    floor: Float[np.ndarray, "N"]
    """The lower edge of the shade: 0 everywhere."""
    frame: Float[np.ndarray, "N"]
    """Invisible points at round limits, which keep the y axis still while V grows."""


@dataclass(frozen=True, kw_only=True)
class ChangePlot:
    tick: Float[np.ndarray, "N"]
    change: Float[np.ndarray, "N"]
    """ΔV of the chunk that begins at the tick."""
    flagged: Float[np.ndarray, "N"]
    """ΔV where flagged, NaN elsewhere."""
    threshold: Float[np.ndarray, "N"]
    """ΔV at or below which chunks were flagged, along the whole axis; NaN before a failure."""
    zero: Float[np.ndarray, "N"]
    frame: Float[np.ndarray, "N"]


def flagged_ticks(flagged: tuple[int, ...], chunk_horizon: int, length: int) -> Bool[np.ndarray, "N"]:
    """Ticks covered by a flagged chunk a_{t:t+H−1}, whose effect is seen until s_{t+H}."""
    covered = np.zeros(length, dtype=bool)
    for tick in flagged:
        covered[max(0, tick) : tick + chunk_horizon + 1] = True
    return covered


def value_plot(telemetry: Telemetry | None) -> ValuePlot:
    values = telemetry.values if telemetry is not None else np.zeros(0)
    length = _length(telemetry)
    value = _padded(bridged(values), length)
    flagged = telemetry.flagged if telemetry is not None else ()
    horizon = telemetry.chunk_horizon if telemetry is not None else 1
    return ValuePlot(
        tick=np.arange(length, dtype=float),
        value=value,
        shade=flagged_ticks(flagged, horizon, length).astype(float),
        floor=np.zeros(length),
        frame=_frame(value, length),
    )


def change_plot(telemetry: Telemetry | None) -> ChangePlot:
    changes = telemetry.value_changes if telemetry is not None else np.zeros(0)
    length = _length(telemetry)
    change = _padded(changes, length)
    flagged = np.full(length, np.nan)
    threshold = math.nan
    if telemetry is not None and len(changes):
        at = [tick for tick in telemetry.flagged if 0 <= tick < len(changes)]
        flagged[at] = change[at]
        threshold = telemetry.threshold
    around_zero = [0.0] if len(changes) else [-0.1, 0.1]
    frame = _frame(np.append(change, around_zero), length)
    return ChangePlot(
        tick=np.arange(length, dtype=float),
        change=change,
        flagged=flagged,
        threshold=np.full(length, threshold),
        zero=np.zeros(length),
        frame=frame,
    )


def bridged(values: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
    """Linear across ticks at which V came too late to be computed; nothing beyond the last known value."""
    known = np.flatnonzero(np.isfinite(values))
    if len(known) == 0:
        return np.full(len(values), np.nan)
    line = np.interp(np.arange(len(values)), known, values[known])
    line[: known[0]] = np.nan
    line[known[-1] + 1 :] = np.nan
    return line


def _length(telemetry: Telemetry | None) -> int:
    if telemetry is None:
        return 151
    return max(telemetry.horizon, len(telemetry.values) - 1, 1) + 1


def _padded(values: Float[np.ndarray, "T"], length: int) -> Float[np.ndarray, "N"]:
    padded = np.full(length, np.nan)
    padded[: len(values)] = values
    return padded


def _frame(values: Float[np.ndarray, "M"], length: int) -> Float[np.ndarray, "N"]:
    """Two points at limits rounded outwards to a fifth of the span's power of ten; the span at least a tenth of V."""
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    span = max(high - low, 0.05, 0.1 * abs(high))
    unit = 10 ** math.floor(math.log10(span)) / 5
    frame = np.full(length, np.nan)
    frame[0] = math.floor(low / unit) * unit
    frame[-1] = math.ceil(max(high, low + span) / unit) * unit
    return frame
