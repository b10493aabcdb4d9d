"""The attempt view's charts as SVG: V, ΔV with its threshold, l⁺ and l⁻. Pure; one x axis, the attempt's tick."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from far_app.types import AdaptationStep
from ui.plot_model import bridged, flagged_ticks
from ui.why_model import Attribution

WIDTH, LEFT, RIGHT, TOP, BOTTOM = 400, 44, 10, 8, 20
RED, BLUE, GREY, GREEN, WHITE = "#ff4d4f", "#3fb8ff", "#b6c6d6", "#2fd07a", "#ffffff"


class _Axes:
    """From values to points of the picture."""

    def __init__(self, last: int, values: Float[np.ndarray, "N"], height: int, zero: bool = False) -> None:
        finite = values[np.isfinite(values)]
        low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
        low, high = (min(low, 0.0), max(high, 0.0)) if zero else (low, high)
        margin = 0.06 * max(high - low, 1e-6)
        self.low, self.high, self.last, self.height = low - margin, high + margin, max(last, 1), height

    def x(self, tick: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * tick / self.last

    def y(self, value: float) -> float:
        return TOP + (self.height - TOP - BOTTOM) * (self.high - value) / (self.high - self.low)

    def line(self, values: Float[np.ndarray, "N"], color: str, width: float, extra: str = "") -> str:
        runs, run = [], []
        for tick, value in enumerate(values):
            if math.isfinite(value):
                run.append(f"{self.x(tick):.1f},{self.y(value):.1f}")
            elif run:
                runs.append(run)
                run = []
        parts = [*runs, run] if run else runs
        return "".join(
            f'<polyline points="{" ".join(p)}" fill="none" stroke="{color}" stroke-width="{width}" {extra}/>'
            for p in parts
        )

    def level(self, value: float, color: str, extra: str = "") -> str:
        y = self.y(value)
        return f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" stroke="{color}" {extra}/>'

    def grid(self) -> str:
        unit = _round_unit((self.high - self.low) / 4)
        y_marks = [k * unit for k in range(math.ceil(self.low / unit), math.floor(self.high / unit) + 1)]
        x_unit = _round_unit(self.last / 6)
        x_marks = [k * x_unit for k in range(math.floor(self.last / x_unit) + 1)]
        parts = [self.level(v, "#1d2833") for v in y_marks]
        parts += [f'<text x="{LEFT - 7}" y="{self.y(v) + 5:.1f}" text-anchor="end">{v:g}</text>' for v in y_marks]
        end = self.height - 7
        parts += [f'<text x="{self.x(v):.1f}" y="{end}" text-anchor="middle">{v:g}</text>' for v in x_marks]
        return "".join(parts)

    def spans(self, covered: Bool[np.ndarray, "N"], fill: str) -> str:
        edges = np.flatnonzero(np.diff(np.concatenate([[False], covered, [False]]).astype(int)))
        return "".join(self.span(a, b - 1, fill) for a, b in zip(edges[::2], edges[1::2], strict=True))

    def span(self, first: float, last: float, fill: str) -> str:
        left, right = self.x(first), self.x(min(last, self.last))
        height = self.height - TOP - BOTTOM
        return f'<rect x="{left:.1f}" y="{TOP}" width="{max(right - left, 1):.1f}" height="{height}" {fill}/>'

    def cursor(self, tick: float) -> str:
        x = self.x(tick)
        ends = f'x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{self.height - BOTTOM}"'
        return f'<line {ends} stroke="{WHITE}" stroke-width="2"/>'

    def svg(self, mark: str, body: str) -> str:
        return f'<svg id="{mark}" viewBox="0 0 {WIDTH} {self.height}">{body}</svg>'


def value_chart(found: Attribution, tick: int, height: int = 140) -> str:
    """V(s_t): flagged chunks shaded red, the chunk on show framed, a line at its start."""
    axes = _Axes(len(found.values) - 1, found.values, height)
    covered = flagged_ticks(found.flagged, found.horizon, len(found.values))
    body = axes.spans(covered, f'fill="{RED}" fill-opacity=".3" class="flagged"') + axes.grid()
    body += axes.span(
        tick, tick + found.horizon, f'fill="{WHITE}" fill-opacity=".1" stroke="{WHITE}" stroke-opacity=".5"'
    )
    body += axes.line(bridged(found.values), BLUE, 2) + axes.cursor(tick)
    if 0 <= tick < len(found.values) and math.isfinite(found.values[tick]):
        body += _dot(axes.x(tick), axes.y(found.values[tick]), BLUE, 4)
    return axes.svg("why-v", body)


def change_chart(found: Attribution, tick: int, height: int = 126) -> str:
    """ΔV of the chunk that begins at each tick, its threshold dashed, flagged ones as red dots; a ring around those
    the operator spoke of."""
    threshold = [found.threshold] if math.isfinite(found.threshold) else []
    axes = _Axes(len(found.values) - 1, np.append(found.changes, threshold), height, zero=True)
    body = axes.grid() + axes.level(0.0, "#4a5d70")
    if threshold:
        body += axes.level(found.threshold, RED, 'stroke-width="2" stroke-dasharray="8 6" class="threshold"')
    body += axes.line(found.changes, GREY, 1.5)
    for t in found.flagged:
        if math.isfinite(found.changes[t]):
            body += _dot(axes.x(t), axes.y(found.changes[t]), RED, 3)
    for t in found.words:
        if 0 <= t < len(found.changes) and math.isfinite(found.changes[t]):
            y = axes.y(found.changes[t])
            body += f'<circle cx="{axes.x(t):.1f}" cy="{y:.1f}" r="7" fill="none" stroke="#ffb224" stroke-width="2.5"/>'
    body += axes.cursor(tick)
    if 0 <= tick < len(found.changes) and math.isfinite(found.changes[tick]):
        body += _dot(axes.x(tick), axes.y(found.changes[tick]), RED if tick in found.flagged else GREY, 5, WHITE)
    return axes.svg("why-dv", body)


def lesson_chart(history: Sequence[AdaptationStep], height: int = 130) -> str:
    """l⁺ (green) and l⁻ (red) over the gradient steps, each relative to its start, per cent."""
    steps = history[-1].steps if history else 10
    change = [np.full(steps + 1, np.nan) for _ in range(2)]
    for h in history:
        if 0 <= h.step <= steps:
            change[0][h.step] = 100 * (h.winner_error / history[0].winner_error - 1) if history[0].winner_error else 0
            change[1][h.step] = 100 * (h.loser_error / history[0].loser_error - 1) if history[0].loser_error else 0
    axes = _Axes(steps, np.concatenate([*change, [-1.0, 1.0]]), height, zero=True)
    body = axes.grid() + axes.level(0.0, "#4a5d70") + axes.line(change[0], GREEN, 3) + axes.line(change[1], RED, 3)
    return axes.svg("why-l", body)


def _dot(x: float, y: float, fill: str, radius: float, edge: str = "none") -> str:
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}" fill="{fill}" stroke="{edge}" stroke-width="1.5"/>'


def _round_unit(span: float) -> float:
    """1, 2 or 5 times a power of ten, at least the span."""
    power = 10 ** math.floor(math.log10(max(span, 1e-9)))
    return next(k * power for k in (1, 2, 5, 10) if k * power >= span * 0.999)
