"""The flat optimiser is AdamW; the guarded step never raises l⁺ to first order."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from far_app.errors import PolicyError
from far_app.learning import adamw
from far_app.learning.adamw import FlatAdamW, guarded_step


def test_flat_adamw_takes_the_steps_of_torchs():
    torch.manual_seed(0)
    ours = [torch.randn(3, 2), torch.randn(4)]
    theirs = [p.clone().requires_grad_() for p in ours]
    flat = FlatAdamW(ours, lr=1e-2)
    torchs = torch.optim.AdamW(theirs, lr=1e-2, weight_decay=0.0)
    for _ in range(5):
        gradient = torch.randn(10)
        flat.step(gradient)
        for p, g in zip(theirs, gradient.split([6, 4]), strict=True):
            p.grad = g.reshape(p.shape)
        torchs.step()
    for a, b in zip(ours, theirs, strict=True):
        assert torch.allclose(a, b, atol=1e-6)


def test_slope_foretells_the_step():
    """Also across pieces."""
    size = adamw.PIECE + 10
    optimiser = FlatAdamW([torch.zeros(size)], lr=1e-2)
    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        g_winner, g_loser = torch.randn(2, size, generator=generator)
        foretold = optimiser.slope(g_winner, g_loser, 0.4)
        before = optimiser.weights.clone()
        optimiser.step(g_winner + 0.4 * g_loser)
        assert foretold == pytest.approx(float(g_winner @ (optimiser.weights - before)), rel=1e-4)


@given(st.integers(0, 100_000), st.floats(-1, 1), st.floats(0.1, 30))
@settings(deadline=None, max_examples=60)
def test_a_guarded_step_never_raises_the_winners_error_to_first_order(seed, alignment, loser_size):
    """Whatever the loser's gradient, fresh moments or old: ⟨∇l⁺, Δθ⟩ ≤ 0."""
    generator = torch.Generator().manual_seed(seed)
    size = 40
    optimiser = FlatAdamW([torch.zeros(size)], lr=1e-2)
    for _ in range(4):
        g_winner = torch.randn(size, generator=generator)
        g_loser = loser_size * (-alignment * g_winner + (1 - abs(alignment)) * torch.randn(size, generator=generator))
        before = optimiser.weights.clone()
        guarded_step(optimiser, g_winner, g_loser)
        assert float(g_winner @ (optimiser.weights - before)) <= 1e-6


def test_an_unopposed_loser_is_not_scaled():
    optimiser = FlatAdamW([torch.zeros(4)], lr=1e-2)
    assert guarded_step(optimiser, torch.tensor([1.0, 0, 0, 0]), torch.tensor([0, 1.0, 0, 0])) == 1.0


def test_a_loser_that_would_undo_the_winner_is_scaled_down():
    optimiser = FlatAdamW([torch.zeros(3)], lr=1e-2)
    g_winner = torch.tensor([1.0, 0.5, 0.1])
    share = guarded_step(optimiser, g_winner, -4.0 * g_winner)
    assert 0.0 < share < 0.25 + 1e-6


def test_a_gradient_that_is_not_finite_is_refused_and_nothing_moves():
    weights = torch.ones(2)
    with pytest.raises(PolicyError, match="not finite"):
        FlatAdamW([weights], lr=1.0).step(torch.tensor([float("nan"), 1.0]))
    assert weights.tolist() == [1.0, 1.0]
