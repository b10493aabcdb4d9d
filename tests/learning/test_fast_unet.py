"""The fast arrangement is the module: same output, same gradient, after every change of the weights."""

import pytest
import torch

from far_app.learning.fast_unet import FastUnet, arrangeable
from far_app.learning.trainable import PlainDenoiser, trainable
from far_app.learning.unet import ConditionalUnet1d


def unet(widths=(64, 128, 256), kernel=3) -> ConditionalUnet1d:
    torch.manual_seed(0)
    return ConditionalUnet1d(7, 20, widths=widths, kernel=kernel).eval()


def inputs(batch: int, horizon: int = 8):
    g = torch.Generator().manual_seed(batch)
    k = torch.randint(0, 100, (batch,), generator=g)
    return torch.randn(batch, horizon, 7, generator=g), k, torch.randn(batch, 20, generator=g)


@pytest.mark.parametrize("widths,horizon", [
    ((64, 128, 256), 8), ((64, 128, 256), 16), ((16, 32), 8), ((16, 32), 4), ((16,), 8), ((8, 16, 32), 4),
])  # fmt: skip
@pytest.mark.parametrize("batch", [1, 70])
def test_the_output_is_the_modules(widths, horizon, batch):
    """In double precision, so that only a real difference shows."""
    net = unet(widths).double()
    noisy, k, features = inputs(batch, horizon)
    with torch.no_grad():
        expected = net(noisy.double(), k, features.double())
        found = FastUnet(net, horizon)(noisy.double(), k, features.double())
    assert torch.allclose(found, expected, atol=1e-9)


def test_the_gradient_is_the_modules():
    net = unet((16, 32, 64))
    expected = torch.autograd.grad(net(*inputs(70)).square().sum(), list(net.parameters()))
    fast = FastUnet(net, 8, train=True)
    found = fast.pull_back(torch.autograd.grad(fast(*inputs(70)).square().sum(), fast.leaves))
    expected = torch.cat([g.flatten() for g in expected])
    assert ((found - expected).norm() / expected.norm()).item() < 1e-5


def test_refresh_follows_the_weights():
    net = unet((16, 32))
    fast = FastUnet(net, 8)
    before = fast(*inputs(3))
    with torch.no_grad():
        for p in net.parameters():
            p.add_(0.01)
        fast.refresh()
        assert not torch.allclose(fast(*inputs(3)), before, atol=1e-4)
        assert torch.allclose(fast(*inputs(3)), net(*inputs(3)), atol=2e-5)


def test_what_it_cannot_arrange_runs_plainly():
    assert arrangeable(unet((16, 32), kernel=5), 8) is None
    assert arrangeable(unet((16, 32, 64)), 6) is None
    assert isinstance(trainable(unet((16, 32), kernel=5), 8), PlainDenoiser)
    assert isinstance(trainable(unet((16, 32)), 8), FastUnet)


def test_the_gradient_repeats_to_the_bit_on_two_threads():
    fast = FastUnet(unet((64, 128)), 8, train=True)
    noisy, k, features = inputs(128)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        found = set()
        for _ in range(10):
            loss = fast(noisy, k, features).square().sum()
            found.add(fast.pull_back(torch.autograd.grad(loss, fast.leaves)).numpy().tobytes())
    finally:
        torch.set_num_threads(threads)
    assert len(found) == 1
