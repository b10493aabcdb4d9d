"""Laws of the noise schedule and of DDIM sampling."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from far_app.learning.diffusion import ALPHA_BARS, TRAIN_STEPS, add_noise, ddim_sample, ddim_steps


def test_schedule_falls_from_almost_one_to_almost_zero():
    assert len(ALPHA_BARS) == TRAIN_STEPS
    assert torch.all(ALPHA_BARS[1:] < ALPHA_BARS[:-1])
    assert ALPHA_BARS[0] > 0.999
    assert ALPHA_BARS[-1] < 1e-3


def test_noised_chunks_keep_unit_variance():
    torch.manual_seed(0)
    chunk, noise = torch.randn(20_000, 2, 2), torch.randn(20_000, 2, 2)
    for k in (0, 30, 99):
        assert abs(add_noise(chunk, noise, torch.full((20_000,), k)).var().item() - 1.0) < 0.03


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31 - 1), st.sampled_from([4, 8, 16]))
def test_ddim_with_the_true_noise_returns_the_clean_chunk(seed, count):
    generator = torch.Generator().manual_seed(seed)
    clean = torch.rand(3, 8, 7, generator=generator) * 1.8 - 0.9
    noise = torch.randn(3, 8, 7, generator=generator)

    def oracle(noisy, k, features):
        bar = ALPHA_BARS[k].view(-1, 1, 1)
        return (noisy - bar.sqrt() * clean) / (1 - bar).sqrt()

    start = add_noise(clean, noise, torch.full((3,), ddim_steps(count)[0]))
    assert torch.allclose(ddim_sample(oracle, torch.zeros(3, 1), start, count), clean, atol=1e-4)


def test_ddim_visits_falling_steps_and_ends_at_the_first():
    assert ddim_steps(8) == [84, 72, 60, 48, 36, 24, 12, 0]
    assert ddim_steps(16)[-1] == 0


def test_samples_stay_within_the_action_range():
    torch.manual_seed(0)
    wild = ddim_sample(lambda x, k, f: 5.0 * torch.randn_like(x), torch.zeros(4, 1), torch.randn(4, 8, 7), 8)
    assert wild.abs().max() <= 1.0 + 1e-5
