"""δ_t: its statistics, its keys, its limits."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from far_app.config import PerturbationConfig
from far_app.perturbation import perturbation, probability

KINDS = st.sampled_from(["gaussian", "smoothed"])


def series(config: PerturbationConfig, scene: int = 1, attempt: int = 2, ticks: int = 4000) -> np.ndarray:
    delta = perturbation(config, scene, attempt)
    return np.stack([delta(t) for t in range(ticks)])


@given(KINDS, st.integers(0, 2**31), st.integers(1, 9))
def test_the_first_attempt_is_unperturbed_and_the_gripper_always(kind, scene, attempt):
    delta = series(PerturbationConfig(kind=kind, probability=1.0), scene, attempt, ticks=20)
    assert (delta[:, 6] == 0).all()
    assert (delta == 0).all() == (attempt == 1)


@given(KINDS, st.integers(0, 1000), st.lists(st.integers(0, 60), min_size=1, max_size=20))
@settings(deadline=None)
def test_a_ticks_perturbation_depends_on_its_key_alone(kind, scene, ticks):
    """Asked in any order, with gaps and twice: the same numbers."""
    config = PerturbationConfig(kind=kind)
    whole = series(config, scene, 3, ticks=61)
    delta = perturbation(config, scene, 3)
    for t in ticks:
        assert np.array_equal(delta(t), whole[t])


def test_scenes_attempts_and_ticks_differ():
    config = PerturbationConfig(probability=1.0)
    base = series(config, ticks=50)
    assert len(np.unique(base[:, 0])) == 50
    assert not np.array_equal(base, series(config, scene=2, ticks=50))
    assert not np.array_equal(base, series(config, attempt=3, ticks=50))


def test_gaussian_has_its_share_and_its_spread():
    """With probability ε, N(0, σ²) on the arm; else nothing. 4,000 ticks: the bounds are five standard errors."""
    delta = series(PerturbationConfig(kind="gaussian", probability=0.5, sigma=0.1))[:, :6]
    moved = (delta != 0).all(axis=1)
    assert ((delta != 0).any(axis=1) == moved).all()
    assert moved.mean() == pytest.approx(0.5, abs=5 * 0.5 / np.sqrt(4000))
    assert delta[moved].std(axis=0) == pytest.approx(np.full(6, 0.1), abs=5 * 0.1 / np.sqrt(2 * 2000))
    assert delta[moved].mean(axis=0) == pytest.approx(np.zeros(6), abs=5 * 0.1 / np.sqrt(2000))
    lagged = np.corrcoef(delta[:-1, 0], delta[1:, 0])[0, 1]
    assert abs(lagged) < 5 / np.sqrt(4000)


def test_smoothed_follows_a_target_held_for_h_ticks():
    """δ_t = α δ_{t−1} + (1 − α) δ*: solved for δ*, it is constant within each block of h ticks and zero in a share
    1 − ε of the blocks."""
    config = PerturbationConfig(kind="smoothed", probability=0.5, sigma=0.1, alpha=0.3, hold=5)
    delta = series(config)[:, :6]
    before = np.concatenate([np.zeros((1, 6)), delta[:-1]])
    targets = ((delta - 0.3 * before) / 0.7).reshape(-1, 5, 6)
    assert np.allclose(targets, targets[:, :1], atol=1e-12)
    held = ~np.isclose(targets[:, 0, 0], 0, atol=1e-12)
    assert held.mean() == pytest.approx(0.5, abs=5 * 0.5 / np.sqrt(800))
    assert targets[held, 0].std() == pytest.approx(0.1, rel=0.1)


def test_smoothed_changes_less_from_tick_to_tick():
    jitter = {k: np.abs(np.diff(series(PerturbationConfig(kind=k)), axis=0)).mean() for k in ("gaussian", "smoothed")}
    assert jitter["smoothed"] < 0.5 * jitter["gaussian"]


def test_only_the_configured_dimensions_move():
    delta = series(PerturbationConfig(dims=(0, 1, 2), probability=1.0), ticks=30)
    assert (delta[:, :3] != 0).all()
    assert (delta[:, 3:] == 0).all()


def test_adaptive_probability_grows_by_a_tenth_a_retry():
    """0.3 + 0.1 k at retry k, the first retry being k = 0 (paper)."""
    config = PerturbationConfig(adaptive=True)
    assert [probability(config, attempt) for attempt in (2, 3, 5)] == pytest.approx([0.3, 0.4, 0.6])
    assert probability(config, 40) == 1.0
    assert probability(PerturbationConfig(probability=0.7), 5) == 0.7


def test_none_is_none():
    assert (series(PerturbationConfig(kind="none"), ticks=20) == 0).all()
