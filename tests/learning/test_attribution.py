"""ΔV and flags: hand-computed cases and laws."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from far_app.config import AttributionConfig
from far_app.errors import ConfigError
from far_app.learning.attribution import corrected, flag, value_change
from far_app.types import FlagCorrection

VALUES = arrays(np.float64, st.integers(10, 60), elements=st.floats(-50, 0, allow_nan=False))


def test_value_change_is_the_difference_over_a_whole_chunk():
    assert value_change(np.array([0.0, 1.0, 3.0, 2.0, -1.0]), horizon=2).tolist() == [3.0, 1.0, -4.0]


@given(VALUES, st.integers(1, 9))
def test_only_whole_chunks_are_ranked(values, horizon):
    """t + H ≤ T: with V(s_0) … V(s_T) that leaves T + 1 − H chunks."""
    assert len(value_change(values, horizon)) == len(values) - horizon


def test_an_attempt_shorter_than_a_chunk_has_nothing_to_blame():
    changes = value_change(np.arange(5.0), horizon=8)
    flags = flag(changes, AttributionConfig())
    assert len(changes) == 0
    assert flags.ticks == ()
    assert math.isnan(flags.threshold)


def test_percentile_flags_the_lowest_tenth():
    """ΔV = 0 … 20: the 10th percentile is 2.0, and 0, 1, 2 lie at or below it."""
    flags = flag(np.arange(21.0)[::-1].copy(), AttributionConfig(rho=10))
    assert flags.threshold == 2.0
    assert flags.ticks == (18, 19, 20)


def test_a_full_attempt_of_the_lift_task_has_fifteen_flagged_chunks():
    assert len(flag(np.random.default_rng(0).normal(size=143), AttributionConfig()).ticks) == 15


@given(VALUES, st.floats(1, 100))
def test_flagged_changes_are_the_smallest(changes, rho):
    flags = flag(changes, AttributionConfig(rho=rho))
    flagged = changes[list(flags.ticks)]
    rest = np.delete(changes, flags.ticks)
    assert len(flagged) >= 1
    assert not len(rest) or flagged.max() <= flags.threshold < rest.min()


@given(VALUES, st.floats(0.1, 10), st.floats(-100, 100))
def test_flags_ignore_the_scale_and_offset_of_v(values, scale, offset):
    values = np.round(values, 3)
    plain = flag(np.round(value_change(values, 4), 6), AttributionConfig(rho=20))
    moved = flag(np.round(value_change(values * scale + offset, 4) / scale, 6), AttributionConfig(rho=20))
    assert plain.ticks == moved.ticks


def test_threshold_and_whole_are_the_papers_ablations():
    changes = np.array([-3.0, 1.0, -0.5, -1.0])
    assert flag(changes, AttributionConfig(rule="threshold", threshold=-1.0)).ticks == (0, 3)
    assert flag(changes, AttributionConfig(rule="whole")).ticks == (0, 1, 2, 3)


def test_an_unknown_value_is_never_flagged():
    assert flag(np.array([np.nan, -1.0, 2.0, np.nan]), AttributionConfig(rule="whole")).ticks == (1, 2)


def test_threshold_without_a_number_says_what_to_set():
    with pytest.raises(ConfigError, match="set it to a value change"):
        flag(np.zeros(3), AttributionConfig(rule="threshold"))


def test_the_operators_last_word_on_a_chunk_overrides_its_value_change():
    words = tuple(
        FlagCorrection(tick=t, flagged=f) for t, f in ((1, False), (4, True), (2, False), (2, True), (9, True))
    )
    assert corrected((1, 2), words, chunks=6) == (2, 4)
