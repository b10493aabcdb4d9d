"""A benchmark's rows, for `far bench all`: one figure each, the plain form beside the fast one of the same run.

Whoever adds a benchmark gives its report a list "rows" of these; docs/performance.md is made of nothing else.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

REPEATS = 30
"""Least number of repeats of anything that is timed."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Medians of `repeats` after a warm-up."""

    what: str
    """What was measured, for people; names the row within its benchmark."""
    unit: str
    """"ms", "s", "1/s" …"""
    fast: float
    """As the program does it."""
    plain: float | None = None
    """The readable reference, in the same run on the same machine; None where there is none."""
    p99: float | None = None
    """Of the fast form."""
    repeats: int = REPEATS
    target: float | None = None
    """What the fast form should reach: at most, or at least where more is better."""
    better: Literal["less", "more"] = "less"

    @property
    def ratio(self) -> float | None:
        """How many times better the fast form is than the plain one."""
        if self.plain is None or not self.plain or not self.fast:
            return None
        return self.plain / self.fast if self.better == "less" else self.fast / self.plain

    @property
    def reached(self) -> bool | None:
        """The target; None without one."""
        if self.target is None:
            return None
        return self.fast <= self.target if self.better == "less" else self.fast >= self.target


def table(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """As a report holds them."""
    return [asdict(row) for row in rows]


def timed(what: Callable[[], object], repeats: int = REPEATS, warm_up: int = 3) -> list[float]:
    """Milliseconds of each of so many calls."""
    spent = []
    for i in range(warm_up + repeats):
        began = time.perf_counter()
        what()
        if i >= warm_up:
            spent.append((time.perf_counter() - began) * 1e3)
    return spent


def timed_side_by_side(
    plain: Callable[[], object], fast: Callable[[], object], repeats: int = REPEATS, warm_up: int = 3
) -> tuple[list[float], list[float]]:
    """Milliseconds of each call of both, in turns, so that a busy machine disturbs both alike."""
    spent: tuple[list[float], list[float]] = ([], [])
    for i in range(warm_up + repeats):
        for call, times in zip((plain, fast), spent, strict=True):
            began = time.perf_counter()
            call()
            if i >= warm_up:
                times.append((time.perf_counter() - began) * 1e3)
    return spent


def row_of(
    what: str, fast: Sequence[float], plain: Sequence[float] | None = None, target: float | None = None
) -> Row:  # fmt: skip
    """From the milliseconds of each repeat."""
    return Row(
        what=what, unit="ms", fast=_rounded(np.median(fast)), p99=_rounded(np.percentile(fast, 99)),
        plain=None if plain is None else _rounded(np.median(plain)), repeats=len(fast), target=target,
    )  # fmt: skip


def _rounded(value: Any) -> float:
    return float(f"{float(value):.4g}")
