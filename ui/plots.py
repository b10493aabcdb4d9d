"""The page's two charts: V(s_t) with flagged chunks shaded, ΔV per chunk with its threshold (ui/plot_model.py)."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import viser
from viser import uplot

from far_app.telemetry import Telemetry
from ui import html
from ui.plot_model import change_plot, value_plot

_RED = "rgb(255, 77, 79)"
_BLUE = "rgb(63, 184, 255)"
_CLEAR = "rgba(0, 0, 0, 0)"


class Plots:
    """Built where it is made in the page; `show` from one thread."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._plotted: tuple[object, ...] = ()
        self._length = 151
        self._nudge = 1.0
        axes = (_axis(size=24), _axis(size=46))
        dots: Any = {"show": False}
        still: Any = {"show": False}
        clear: Any = {"stroke": _CLEAR, "points": dots, "scale": "flag"}
        frame: Any = {"stroke": _CLEAR, "points": dots}
        nudge: Any = {"stroke": _CLEAR, "points": dots, "scale": "nudge"}
        # Only `frame` sets the y axis: a series that begins with NaN would make uPlot's range NaN.
        v = value_plot(None)
        self._value_caption = gui.add_html(html.value_caption(None))
        self._value = gui.add_uplot(
            (v.tick, v.shade, v.floor, v.value, v.frame, v.floor),
            (
                {"label": "tick"},
                clear,
                clear,
                {"stroke": _BLUE, "width": 2.5, "points": dots, "auto": False},
                frame,
                nudge,
            ),
            bands=(uplot.Band(series=(1, 2), fill="rgba(255, 77, 79, 0.38)"),),
            scales=_scales(150) | {"flag": uplot.Scale(range=(0.0, 1.0))},
            axes=axes, legend={"show": False}, cursor=still, aspect=2.6, padding=(8, 20, 0, 0),
        )  # fmt: skip
        c = change_plot(None)
        self._change_caption = gui.add_html(html.change_caption(None))
        flagged: Any = {"show": True, "size": 8, "fill": _RED, "stroke": _RED}
        self._change = gui.add_uplot(
            (c.tick, c.zero, c.change, c.threshold, c.flagged, c.frame, c.zero),
            (
                {"label": "tick"},
                {"stroke": "rgb(59, 76, 94)", "width": 1, "points": dots, "auto": False},
                {"stroke": "rgb(170, 190, 208)", "width": 2, "points": dots, "auto": False},
                {"stroke": _RED, "width": 1.5, "dash": (6, 5), "points": dots, "auto": False},
                {"stroke": _CLEAR, "points": flagged, "auto": False},
                frame,
                nudge,
            ),
            scales=_scales(150),
            axes=axes, legend={"show": False}, cursor=still, aspect=2.85, padding=(8, 20, 0, 0),
        )  # fmt: skip

    def show(self, telemetry: Telemetry) -> None:
        """Sent when something changed, and every two seconds.

        uplot-react forgets to lay out the axes when new data comes in the very render in which a chart learns its
        width, and stays so until some scale changes: an invisible series on a scale of its own makes one change."""
        t = telemetry
        last = float(t.values[-1]) if len(t.values) else 0.0
        beat = int(time.monotonic() / 2)
        key = (t.trial, t.attempt, len(t.values), last, len(t.value_changes), t.flagged, t.horizon, beat)
        if key == self._plotted:
            return
        self._plotted = key
        v, c = value_plot(t), change_plot(t)
        self._nudge = 3.0 - self._nudge
        if len(v.tick) != self._length:
            self._length = len(v.tick)
            self._value.scales = _scales(self._length - 1) | {"flag": uplot.Scale(range=(0.0, 1.0))}
            self._change.scales = _scales(self._length - 1)
        self._value_caption.content, self._change_caption.content = html.value_caption(t), html.change_caption(t)
        nudge = np.linspace(0, self._nudge, len(v.tick))
        self._value.data = (v.tick, v.shade, v.floor, v.value, v.frame, nudge)
        self._change.data = (c.tick, c.zero, c.change, c.threshold, c.flagged, c.frame, nudge)


def _scales(last_tick: int) -> dict[str, Any]:
    """A fixed x range: with an automatic one viser keeps 0 … 1 of a plot that began without data."""
    return {"x": uplot.Scale(time=False, range=(0.0, float(last_tick)))}


def _axis(size: int) -> Any:
    return {
        "stroke": "rgb(143, 161, 179)", "size": size, "font": "14px sans-serif", "gap": 4,
        "grid": {"stroke": "rgba(255, 255, 255, 0.05)", "width": 1}, "ticks": {"show": False},
    }  # fmt: skip
