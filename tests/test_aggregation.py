"""Temporal aggregation: the uniform mean of every chunk that reaches a tick."""

import numpy as np
import pytest

from far_app.aggregation import Plan
from far_app.types import ActionChunk


def chunk(tick: int, level: float, value: float = 0.0) -> ActionChunk:
    actions = np.tile(level + 0.01 * np.arange(8)[:, None], (1, 7))
    return ActionChunk(tick=tick, actions=actions, policy_version="v", value=value)


def test_each_chunk_answers_for_the_tick_at_its_own_index():
    plan = Plan(horizon=8)
    plan.add(chunk(0, 0.0))
    plan.add(chunk(2, 0.5))
    assert plan.action(3) == pytest.approx(np.full(7, (0.03 + 0.51) / 2))


def test_a_chunk_from_the_future_is_not_used():
    plan = Plan(horizon=8)
    plan.add(chunk(5, 1.0))
    assert plan.action(3) is None


def test_at_most_h_chunks_take_part_and_old_ones_are_forgotten():
    plan = Plan(horizon=8)
    for tick in range(12):
        plan.add(chunk(tick, 0.1 * tick))
    expected = np.mean([0.1 * t + 0.01 * (11 - t) for t in range(4, 12)])
    assert plan.action(11) == pytest.approx(np.full(7, expected))


def test_with_no_chunk_left_there_is_no_action():
    plan = Plan(horizon=8)
    plan.add(chunk(0, 0.0))
    assert plan.action(7) is not None
    assert plan.action(8) is None


def test_the_value_belongs_to_the_very_tick():
    plan = Plan(horizon=8)
    plan.add(chunk(4, 0.0, value=-3.0))
    assert plan.value(4) == -3.0
    assert np.isnan(plan.value(5))
