"""Statistics of a dataset's features as LeRobot keeps them: min, max, mean, std, count and five quantiles.

Pictures are summed up as a histogram of each channel: exact, since a channel has 256 values, and adding up over
episodes costs nothing. Their statistics are those of values in [0, 1], shaped (3, 1, 1).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Int, UInt8

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
STATISTICS = ("min", "max", "mean", "std", "count", *QUANTILES)

Stats = dict[str, np.ndarray]


def array_stats(column: np.ndarray) -> Stats:
    """Of a column of N values or vectors, over its N rows; NaN (unknown) entries are passed over, and a component
    that is nowhere known counts as 0."""
    rows = column.reshape(len(column), -1).astype(np.float64)
    known = np.isfinite(rows)
    rows[:, ~known.any(axis=0)] = 0.0
    rows[~np.isfinite(rows)] = np.nan
    found = {
        "min": np.nanmin(rows, axis=0), "max": np.nanmax(rows, axis=0), "mean": np.nanmean(rows, axis=0),
        "std": np.nanstd(rows, axis=0), "count": np.array([len(rows)]),
    }  # fmt: skip
    return found | {name: np.nanquantile(rows, q, axis=0) for name, q in QUANTILES.items()}


def histogram(frames: Iterable[UInt8[np.ndarray, "H W 3"]]) -> Int[np.ndarray, "3 256"]:
    """How often each channel took each value."""
    counts = np.zeros((3, 256), np.int64)
    for frame in frames:
        for channel in range(3):
            counts[channel] += np.bincount(frame[..., channel].ravel(), minlength=256)
    return counts


def image_stats(counts: Int[np.ndarray, "3 256"], frames: int) -> Stats:
    """Of pictures with that histogram."""
    values = np.arange(256) / 255.0
    share = counts / counts.sum(axis=1, keepdims=True)
    mean = share @ values
    found = {
        "min": values[(counts > 0).argmax(axis=1)],
        "max": values[255 - (counts > 0)[:, ::-1].argmax(axis=1)],
        "mean": mean,
        "std": np.sqrt(np.maximum(share @ values**2 - mean**2, 0.0)),
    }
    found |= {name: _quantile(share, values, q) for name, q in QUANTILES.items()}
    return {name: value.reshape(3, 1, 1) for name, value in found.items()} | {"count": np.array([frames])}


def _quantile(share: Float[np.ndarray, "3 256"], values: Float[np.ndarray, "256"], q: float) -> Float[np.ndarray, "3"]:
    """The smallest value that at least a share q of the pixels does not exceed."""
    return values[(share.cumsum(axis=1) >= q - 1e-12).argmax(axis=1)]
