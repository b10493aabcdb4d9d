"""Where the loop's time goes, as a strip along the page's foot: a column a tenth of a second, stages stacked, against
the budget of one tick. Pure; drawn anew twice a second, when the app tells it (LoopHealth.stages).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from far_app.telemetry import Telemetry
from far_app.types import TICK_STAGES

COLUMNS = 100
"""Of three ticks each at 30 Hz: ten seconds."""
WIDTH, HEIGHT = 1000, 100
COLORS = {
    "observe": "#5f7fa8", "infer": "#3fb8ff", "aggregate": "#35c9a5", "filter": "#e6c35c", "send": "#f08c5a",
    "record": "#c58bff", "publish": "#8fa1b3",
}  # fmt: skip
"""One a stage of far_app.types.TICK_STAGES, from the axis upwards."""


def slowest(stages: Float[np.ndarray, "T S"], columns: int = COLUMNS) -> Float[np.ndarray, "C S"]:
    """Each column the slowest of its three ticks, whole, so that one bad tick is seen and stages still add up; newest
    last, zeros where there is nothing yet."""
    each = 3
    rows = np.zeros((columns * each, len(TICK_STAGES)), np.float32)
    newest = stages[-len(rows) :]
    rows[len(rows) - len(newest) :] = newest
    grouped = rows.reshape(columns, each, -1)
    return grouped[np.arange(columns), grouped.sum(axis=2).argmax(axis=1)]


def areas(ms: Float[np.ndarray, "C S"], budget: float) -> list[str]:
    """SVG path of each stage, stacked; the picture's top is 1.25 times the budget, and what exceeds it is cut off."""
    heights = np.cumsum(np.column_stack([np.zeros(len(ms)), ms]), axis=1)
    y = HEIGHT * (1 - np.minimum(heights / (1.25 * budget), 1))
    step = WIDTH / len(ms)

    def outline(i: int) -> str:
        upper = " ".join(f"H{c * step:.0f}V{v:.1f}H{(c + 1) * step:.0f}" for c, v in enumerate(y[:, i + 1]))
        lower = " ".join(f"V{y[c, i]:.1f}H{c * step:.0f}" for c in reversed(range(len(ms))))
        return f"M0 {y[0, i]:.1f}V{y[0, i + 1]:.1f}{upper} {lower}Z"

    return [outline(i) for i in range(ms.shape[1])]


def tick_strip(telemetry: Telemetry | None) -> str:
    """The whole strip: what a tick takes (the median), legend, picture."""
    stages = telemetry.loop.stages if telemetry is not None else np.zeros((0, len(TICK_STAGES)), np.float32)
    budget = 1000.0 / (telemetry.rate if telemetry is not None else 30.0)
    typical = f"median {np.median(stages.sum(axis=1)):.1f} of {budget:.1f} ms" if len(stages) else "nothing ran yet"
    legend = "".join(f'<span><i style="background:{COLORS[name]}"></i>{name}</span>' for name in TICK_STAGES)
    drawn = "".join(
        f'<path d="{path}" fill="{COLORS[name]}"/>'
        for name, path in zip(TICK_STAGES, areas(slowest(stages), budget), strict=True)
    )
    line = HEIGHT * (1 - 1 / 1.25)
    return f"""<div class="far-card far-strip" id="op-strip" data-ticks="{len(stages)}"><h2>Tick
<em>{typical}</em></h2><div class="far-legend">{legend}</div>
<svg viewBox="0 0 {WIDTH} {HEIGHT}" preserveAspectRatio="none">{drawn}
<line x1="0" x2="{WIDTH}" y1="{line:.1f}" y2="{line:.1f}"/></svg></div>"""
