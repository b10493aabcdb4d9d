"""The kernels are torch's own operations: same values, same gradients, far out too."""

import pytest
import torch
from torch.nn import functional

from far_app.learning import kernels


def given(batch: int, length: int, channels: int, spread: float):
    g = torch.Generator().manual_seed(channels)
    x = torch.randn(batch, length, channels, generator=g)
    scale, offset = spread * torch.randn(channels, generator=g), spread * torch.randn(channels, generator=g)
    film = torch.randn(batch, 2 * channels + 5, generator=g)
    return [a.requires_grad_() for a in (x, scale, offset, film)]


def arrays(*tensors):
    return [t.detach().numpy() for t in tensors]


@pytest.mark.parametrize("filmed", [False, True])
@pytest.mark.parametrize("spread", [1.0, 30.0])
@pytest.mark.parametrize("batch,length,channels,groups", [(1, 8, 32, 8), (37, 2, 64, 8), (5, 3, 24, 4), (2, 4, 8, 4)])
def test_norm_mish_and_its_gradients(batch, length, channels, groups, spread, filmed):
    x, scale, offset, film = given(batch, length, channels, spread)
    expected = functional.mish(functional.group_norm(x.transpose(1, 2), groups, scale, offset, 1e-5)).transpose(1, 2)
    if filmed:
        gain, shift = film[:, None, 3 : 3 + 2 * channels].chunk(2, dim=2)
        expected = expected * gain + shift
    gradient = torch.randn(batch, length, channels, generator=torch.Generator().manual_seed(1))
    slopes = torch.autograd.grad(expected, [x, scale, offset, film], gradient, materialize_grads=True)

    at = 3 if filmed else -1
    found, mean, rstd = torch.empty_like(x), torch.empty(batch, groups), torch.empty(batch, groups)
    kernels.norm_mish(*arrays(x, scale, offset), 1e-5, *arrays(film), at, *arrays(found, mean, rstd))
    own = [torch.empty_like(x), torch.empty(channels), torch.empty(channels), torch.zeros_like(film)]
    kernels.norm_mish_back(
        *arrays(gradient, x, scale, offset, mean, rstd, film), at, *arrays(*own)
    )  # fmt: skip

    assert torch.allclose(found, expected, atol=5e-6 * spread, rtol=1e-5)
    for mine, slope in zip(own, slopes, strict=True):
        assert torch.allclose(mine, slope, atol=5e-5 * max(1.0, float(slope.abs().max())))


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("length", [2, 4, 8])
def test_taps_are_what_a_convolution_sees_and_their_gradient_goes_back(stride, length):
    g = torch.Generator().manual_seed(0)
    x, weight = torch.randn(3, length, 5, generator=g).requires_grad_(), torch.randn(7, 5, 3, generator=g)
    expected = functional.conv1d(x.transpose(1, 2), weight, stride=stride, padding=1).transpose(1, 2)
    beside = torch.empty(3, length // stride, 5, 3)
    kernels.taps(*arrays(x), stride, *arrays(beside))
    matrix = weight.flatten(1)
    assert torch.allclose(beside.flatten(2) @ matrix.T, expected, atol=1e-5)

    gradient = torch.randn(expected.shape, generator=g)
    (slope,) = torch.autograd.grad(expected, x, gradient)
    to_x = torch.empty_like(x)
    kernels.taps_back(*arrays((gradient @ matrix).view(3, -1, 5, 3)), stride, *arrays(to_x))
    assert torch.allclose(to_x, slope, atol=1e-5)


@pytest.mark.parametrize("sign", [1, -1])
def test_mish_far_out(sign):
    """From where exp overflows to where mish is nothing."""
    x = sign * torch.linspace(1e-3, 90.0, 64)[None, None]
    found, mean, rstd = torch.empty_like(x), torch.empty(1, 1), torch.empty(1, 1)
    one, zero = torch.full((64,), float(x.std(correction=0))), torch.full((64,), float(x.mean()))
    kernels.norm_mish(*arrays(x, one, zero), 0.0, *arrays(torch.zeros(1, 1)), -1, *arrays(found, mean, rstd))
    assert torch.allclose(found, functional.mish(x), atol=1e-4, rtol=1e-5)


def test_a_value_that_is_not_finite_stays_one():
    """Not a number in one chunk is not a number in its result, and nowhere else."""
    x, scale, offset, film = given(3, 2, 16, 1.0)
    with torch.no_grad():
        x[1, 0, 3] = torch.nan
    found, mean, rstd = torch.empty_like(x), torch.empty(3, 4), torch.empty(3, 4)
    kernels.norm_mish(*arrays(x, scale, offset), 1e-5, *arrays(film), 3, *arrays(found, mean, rstd))
    bad = torch.zeros(3, 2, 16, dtype=torch.bool)
    bad[1, :, :4] = True  # its group of channels
    assert torch.equal(~torch.isfinite(found), bad)
    own = [torch.empty_like(x), torch.empty(16), torch.empty(16), torch.zeros_like(film)]
    kernels.norm_mish_back(*arrays(found, x, scale, offset, mean, rstd, film), 3, *arrays(*own))
    assert torch.equal(~torch.isfinite(own[0]), bad)
    assert not torch.isfinite(own[1][:4]).any() and torch.isfinite(own[1][4:]).all()
