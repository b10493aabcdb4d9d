"""The strip of the ticks' stages: every tick that took long is seen, stages stack up, the budget is where it says."""

import re
from dataclasses import replace

import numpy as np
import pytest
from ui_stage import running

from far_app.types import TICK_STAGES
from ui.tick_strip import COLORS, HEIGHT, areas, slowest, tick_strip

SEVEN = len(TICK_STAGES)


def heights(path: str) -> list[float]:
    """All y of an outline."""
    return [float(y) for y in re.findall(r"V([\d.]+)", path)]


def test_one_bad_tick_in_ten_seconds_is_seen_whole():
    stages = np.full((300, SEVEN), 0.5, np.float32)
    stages[151] = [20, 1, 2, 3, 4, 5, 6]
    columns = slowest(stages)
    assert columns.shape == (100, SEVEN)
    assert columns[50].tolist() == [20, 1, 2, 3, 4, 5, 6]
    assert np.count_nonzero(columns.sum(axis=1) > 4) == 1


def test_a_short_session_fills_the_strip_from_the_right():
    columns = slowest(np.ones((5, SEVEN), np.float32))
    assert columns[:98].sum() == 0 and (columns[98:] == 1).all()


def test_stages_stand_on_each_other_and_the_budget_is_four_fifths_up():
    ms = np.array([[10.0, 0, 0, 0, 0, 0, 30.0], [40.0, 0, 0, 0, 0, 0, 400.0]])
    first, *_, last = areas(ms, budget=40.0)
    assert min(heights(first)) == pytest.approx(HEIGHT * 0.2), "40 of 40 ms reach the budget's line"
    assert set(heights(first)) == {80.0, 20.0, 100.0}
    assert min(heights(last)) == 0.0, "what exceeds the picture is cut off"
    assert 20.0 in heights(last), "10 + 30 ms"


def test_the_legend_names_every_stage_and_the_caption_says_what_a_tick_takes():
    assert set(COLORS) == set(TICK_STAGES)
    shown = running()
    stages = np.tile(np.arange(1, SEVEN + 1, dtype=np.float32), (9, 1))
    stages[0] = 100
    page = tick_strip(replace(shown, loop=replace(shown.loop, stages=stages)))
    assert re.findall(r"</i>(\w+)", page) == list(TICK_STAGES)
    assert "median 28.0 of 33.3 ms" in page and 'data-ticks="9"' in page


def test_before_the_first_tick_it_says_so():
    assert "nothing ran yet" in tick_strip(None)
