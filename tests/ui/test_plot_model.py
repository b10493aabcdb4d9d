"""The plots' arrays: shading where a chunk is flagged, no NaN where uPlot would shade the wrong region."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from ui_stage import HORIZON, H, adapting, running

from ui.plot_model import bridged, change_plot, flagged_ticks, value_plot


def test_exactly_the_flagged_chunks_are_shaded() -> None:
    plot = value_plot(replace(adapting(), flagged=(10, 12, 60)))
    shaded = np.flatnonzero(plot.shade)
    assert shaded.tolist() == [*range(10, 12 + H + 1), *range(60, 60 + H + 1)]


def test_nothing_is_shaded_before_a_failure() -> None:
    assert not value_plot(running()).shade.any()


def test_series_have_one_length_and_shades_are_never_nan() -> None:
    for telemetry in (None, running(0), running(), adapting()):
        v, c = value_plot(telemetry), change_plot(telemetry)
        assert {len(a) for a in (v.tick, v.value, v.shade, v.floor, v.frame)} == {HORIZON + 1}
        assert {len(a) for a in (c.tick, c.change, c.flagged, c.threshold, c.zero, c.frame)} == {HORIZON + 1}
        assert np.isfinite(v.shade).all()
        assert np.isfinite(v.floor).all()
        assert np.isfinite([v.frame[0], v.frame[-1], c.frame[0], c.frame[-1]]).all()


def test_a_flagged_chunk_at_the_very_end_stays_inside() -> None:
    assert flagged_ticks((148,), 8, 151).sum() == 3


def test_flags_outside_the_changes_are_left_out() -> None:
    plot = change_plot(replace(adapting(), flagged=(3, 9999)))
    assert np.flatnonzero(np.isfinite(plot.flagged)).tolist() == [3]


def test_every_flagged_change_lies_at_or_below_the_threshold_line() -> None:
    plot = change_plot(adapting())
    at = np.isfinite(plot.flagged)
    assert at.any()
    assert (plot.flagged[at] <= plot.threshold[at]).all()


def test_gaps_are_bridged_but_the_future_is_not_invented() -> None:
    nan = np.nan
    line = bridged(np.array([nan, 1.0, nan, 3.0, nan]))
    np.testing.assert_array_equal(line, [nan, 1.0, 2.0, 3.0, nan])
    assert np.isnan(bridged(np.full(4, nan))).all()


def test_the_axis_frame_holds_every_value() -> None:
    plot = value_plot(adapting())
    assert plot.frame[0] <= np.nanmin(plot.value)
    assert plot.frame[-1] >= np.nanmax(plot.value)
