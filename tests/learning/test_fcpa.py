"""The preference update: the printed formula, its gradient, shared draws, guards, cancellation, NaN."""

import copy
import dataclasses
import math

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional

from far_app.config import FCPAConfig
from far_app.errors import ConfigError
from far_app.learning import diffusion, fcpa, preference
from far_app.learning.cancellation import AdaptationCancelledError, never
from far_app.learning.fast_unet import FastUnet
from far_app.learning.pairs import Pairs
from far_app.learning.preference import Cloning, Demonstrations, Noising, Objective, draw
from far_app.learning.trainable import Trainable, trainable
from far_app.learning.unet import ConditionalUnet1d

H, A, F = 8, 7, 12
LIKE = torch.zeros(1, H, A)
NOISING = Noising(add_noise=diffusion.add_noise, steps=diffusion.TRAIN_STEPS)


def unet(seed: int = 0) -> nn.Module:
    torch.manual_seed(seed)
    return ConditionalUnet1d(A, F, widths=(16, 32)).eval()


def some_pairs(states: int = 3, positives: int = 2, seed: int = 0) -> Pairs:
    g = torch.Generator().manual_seed(seed)
    return Pairs(
        features=torch.randn(states, F, generator=g),
        negatives=torch.rand(states, H, A, generator=g) * 2 - 1,
        positives=torch.rand(states * positives, H, A, generator=g) * 2 - 1,
        owner=torch.arange(states).repeat_interleave(positives),
        weights=torch.ones(states * positives),
    )


def run(config: FCPAConfig, pairs: Pairs | None = None, net: nn.Module | None = None, seed: int = 0, **kwargs):
    net = net or unet()
    update = fcpa.adapt(
        net, NOISING, pairs or some_pairs(), config, np.random.default_rng(seed), kwargs.pop("cancelled", never),
        kwargs.pop("progress", lambda step: None), **kwargs,
    )  # fmt: skip
    return net, update


def runner(net: nn.Module) -> Trainable:
    return trainable(net, horizon=H)


def flat(net: nn.Module) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in net.parameters()])


@pytest.mark.parametrize("states,draws", [(1, 1), (3, 2), (15, 2), (4, 8)])
def test_k_is_stratified_over_the_diffusion_steps(states, draws):
    """Each state has one k in each of `draws` equal ranges; over the states each range is spread evenly."""
    k = draw(np.random.default_rng(0), states, draws, 100, LIKE).k.numpy()
    assert ((k >= 0) & (k < 100)).all()
    ranges = np.arange(draws) * 100 / draws
    assert ((k >= np.floor(ranges)) & (k < np.ceil(ranges + 100 / draws))).all()
    cells = np.arange(states * draws + 1) * 100 / (states * draws)
    for cell, value in enumerate(np.sort(k, axis=0).T.flatten()):
        assert math.floor(cells[cell]) <= value <= math.ceil(cells[cell + 1])


def reference_errors(net, chunks, features, draws, owner, reduction):
    """l_diff with plain loops."""
    out = []
    for chunk, state in zip(chunks, owner.tolist(), strict=True):
        total = 0.0
        for k, noise in zip(draws.k[state], draws.noise[state], strict=True):
            bar = diffusion.ALPHA_BARS[k]
            noisy = bar.sqrt() * chunk + (1 - bar).sqrt() * noise
            squared = (noise - net(noisy[None], k[None], features[state][None])[0]) ** 2
            total = total + (squared.sum() if reduction == "sum" else squared.mean())
        out.append(total / len(draws.k[state]))
    return torch.stack(out)


@pytest.mark.parametrize("reduction", ["sum", "mean"])
def test_loss_and_gradient_are_the_printed_formula(reduction):
    """Mean over pairs of −log σ(β [l(a⁻) − l(a⁺)]), with the same (k, ε) for a state's negative and positives."""
    net, pairs, config = unet(), some_pairs(states=20, positives=3), FCPAConfig(reduction=reduction, draws=2)
    draws = draw(np.random.default_rng(3), 20, 2, 100, LIKE)
    objective = Objective(runner(net), NOISING, pairs, config, never)
    loss, winner, loser = objective.report(draws)

    plus = reference_errors(net, pairs.positives, pairs.features, draws, pairs.owner, reduction)
    minus = reference_errors(net, pairs.negatives, pairs.features, draws, torch.arange(20), reduction)[pairs.owner]
    expected = -torch.log(torch.sigmoid(0.1 * (minus - plus))).mean()
    assert loss == pytest.approx(expected.item(), rel=1e-5)
    assert winner == pytest.approx(plus.mean().item(), rel=1e-5)
    assert loser == pytest.approx(minus.mean().item(), rel=1e-5)

    gradient = torch.cat([g.flatten() for g in torch.autograd.grad(expected, list(net.parameters()))])
    g_winner, g_loser = objective.gradients(draws)
    assert torch.allclose(g_winner + g_loser, gradient, atol=1e-5, rtol=1e-3)


def test_a_chunk_paired_with_itself_teaches_nothing():
    """Shared noise: with a⁺ = a⁻ both errors are equal draw by draw, so the gradients cancel exactly."""
    pairs = some_pairs(positives=1)
    same = Pairs(
        features=pairs.features, negatives=pairs.negatives, positives=pairs.negatives, owner=torch.arange(3),
        weights=torch.ones(3),
    )  # fmt: skip
    objective = Objective(runner(unet()), NOISING, same, FCPAConfig(), never)
    g_winner, g_loser = objective.gradients(draw(np.random.default_rng(0), 3, 2, 100, LIKE))
    assert g_winner.norm() > 0
    assert torch.allclose(g_winner, -g_loser, atol=1e-6)


def test_the_update_prefers_the_positives():
    """After a strong update l⁻ − l⁺ on fixed draws has grown and the loss has fallen."""
    _, update = run(FCPAConfig(lr=1e-3, steps=10, draws=4))
    first, last = update.history[0], update.history[-1]
    assert update.status == "adapted"
    assert last.loss < first.loss
    assert last.loser_error - last.winner_error > first.loser_error - first.winner_error


def test_history_has_the_state_before_and_after_every_step():
    seen = []
    _, update = run(FCPAConfig(steps=4), progress=seen.append)
    assert [s.step for s in update.history] == [0, 1, 2, 3, 4]
    assert tuple(seen) == update.history


def test_what_is_told_to_people_alone_is_of_each_states_first_pairs():
    pairs = some_pairs(states=3, positives=4)
    few = dataclasses.replace(pairs, positives=pairs.positives[[0, 1, 4, 5, 8, 9]], owner=pairs.owner[::2],
                              weights=pairs.weights[::2])  # fmt: skip
    draws = draw(np.random.default_rng(0), 3, 1, 100, LIKE)
    told = Objective(runner(unet()), NOISING, pairs, FCPAConfig(), never).report(draws, most=2)
    assert told == Objective(runner(unet()), NOISING, few, FCPAConfig(), never).report(draws)
    config = FCPAConfig(steps=2, guard="stop", guard_rise=1e9)
    _, unguarded = run(dataclasses.replace(config, guard="none"), pairs)
    _, guarded = run(config, pairs)
    _, few_guarded = run(config, few)
    assert unguarded.history[0] == few_guarded.history[0] != guarded.history[0], "a guard decides by all of them"


def test_no_steps_change_nothing():
    net = unet()
    before = flat(net)
    _, update = run(FCPAConfig(steps=0), net=net)
    assert not update.changed
    assert torch.equal(flat(net), before)


def test_a_seed_repeats_the_update():
    one, _ = run(FCPAConfig(steps=3, lr=1e-3), seed=7)
    two, _ = run(FCPAConfig(steps=3, lr=1e-3), seed=7)
    other, _ = run(FCPAConfig(steps=3, lr=1e-3), seed=8)
    assert torch.equal(flat(one), flat(two))
    assert not torch.equal(flat(one), flat(other))


@pytest.mark.parametrize("objective,uses_winner,uses_loser", [
    ("pairwise", True, True), ("no_positive", False, True), ("no_negative", True, False), ("awr", True, False),
])  # fmt: skip
def test_ablations_leave_one_side_out(objective, uses_winner, uses_loser):
    draws = draw(np.random.default_rng(0), 3, 2, 100, LIKE)
    objective_ = Objective(runner(unet()), NOISING, some_pairs(), FCPAConfig(objective=objective), never)
    g_winner, g_loser = objective_.gradients(draws)
    assert (g_winner.norm() > 0) == uses_winner
    assert (g_loser.norm() > 0) == uses_loser


def test_awr_weights_the_error_of_each_chunk():
    net, pairs = unet(), some_pairs(positives=1)
    weighted = Pairs(
        features=pairs.features, negatives=pairs.positives, positives=pairs.positives, owner=torch.arange(3),
        weights=torch.tensor([2.0, 0.0, 1.0]),
    )  # fmt: skip
    draws = draw(np.random.default_rng(0), 3, 2, 100, LIKE)
    loss, _, loser = Objective(runner(net), NOISING, weighted, FCPAConfig(objective="awr"), never).report(draws)
    errors = reference_errors(net, pairs.positives, pairs.features, draws, torch.arange(3), "sum")
    assert loss == pytest.approx(((2 * errors[0] + errors[2]) / 3).item(), rel=1e-5)
    assert math.isnan(loser)


def opposing_pairs() -> Pairs:
    """Positives close to their negatives: lowering one error lowers the other, so l⁺ pays for raising l⁻."""
    pairs = some_pairs(states=4, positives=2)
    near = pairs.negatives[pairs.owner] + 0.02 * torch.randn(8, H, A, generator=torch.Generator().manual_seed(1))
    return Pairs(
        features=pairs.features, negatives=pairs.negatives, positives=near, owner=pairs.owner, weights=pairs.weights
    )


def trained(net: nn.Module, pairs: Pairs) -> nn.Module:
    """Fitted to the chunks at hand, as a policy is to what it does."""
    optimizer = torch.optim.Adam(net.parameters(), lr=2e-3)
    chunks, features = pairs.positives, pairs.features[pairs.owner]
    generator = torch.Generator().manual_seed(0)
    for _ in range(150):
        k = torch.randint(0, 100, (len(chunks),), generator=generator)
        noise = torch.randn(chunks.shape, generator=generator)
        loss = functional.mse_loss(net(diffusion.add_noise(chunks, noise, k), k, features), noise)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return net.eval()


@pytest.fixture(scope="module")
def fitted() -> nn.Module:
    return trained(unet(), opposing_pairs())


def test_unguarded_the_printed_loss_raises_both_errors(fitted):
    """The known trouble (paper/choices.md 4b in small): with near pairs and a fitted policy l⁺ rises with l⁻."""
    _, update = run(FCPAConfig(lr=2e-3, draws=4), opposing_pairs(), copy.deepcopy(fitted))
    assert update.history[-1].winner_error > update.history[0].winner_error * 1.05
    assert update.history[-1].loser_error > update.history[0].loser_error


def test_stop_undoes_the_step_that_raised_the_winners_error(fitted):
    net = copy.deepcopy(fitted)
    _, update = run(FCPAConfig(lr=2e-3, draws=4, guard="stop", guard_rise=0.05), opposing_pairs(), net)
    limit = update.history[0].winner_error * 1.05
    assert update.status == "stopped"
    assert update.history[-1].winner_error > limit
    assert all(step.winner_error <= limit for step in update.history[:-1])
    plain, _ = run(FCPAConfig(lr=2e-3, draws=4, steps=len(update.history) - 2), opposing_pairs(), copy.deepcopy(fitted))
    assert torch.equal(flat(net), flat(plain))
    assert update.changed == (len(update.history) > 2)


def test_scale_keeps_the_winners_error_lower_than_the_printed_loss_does(fitted):
    config = FCPAConfig(lr=2e-3, draws=4, guard="scale", guard_rise=10.0)
    _, guarded = run(config, opposing_pairs(), copy.deepcopy(fitted))
    _, printed = run(FCPAConfig(lr=2e-3, draws=4), opposing_pairs(), copy.deepcopy(fitted))
    assert guarded.history[-1].winner_error < printed.history[-1].winner_error


def test_behaviour_cloning_pulls_towards_the_demonstrations(fitted):
    demonstrations = Demonstrations(
        features=opposing_pairs().features[opposing_pairs().owner], chunks=opposing_pairs().positives
    )
    config = FCPAConfig(lr=2e-3, draws=4, guard="bc", bc_weight=1.0)
    _, cloned = run(config, opposing_pairs(), copy.deepcopy(fitted), demonstrations=demonstrations)
    _, printed = run(FCPAConfig(lr=2e-3, draws=4), opposing_pairs(), copy.deepcopy(fitted))
    assert cloned.history[-1].winner_error < printed.history[-1].winner_error


def test_cloning_is_added_once_beside_any_number_of_states():
    net, pairs = unet(), some_pairs(states=preference.STATES_AT_ONCE + 4)
    objective = Objective(runner(net), NOISING, pairs, FCPAConfig(), never)
    g = torch.Generator().manual_seed(1)
    shown = Demonstrations(features=torch.randn(9, F, generator=g), chunks=torch.rand(9, H, A, generator=g))
    draws = draw(np.random.default_rng(2), len(pairs.features), 2, NOISING.steps, LIKE)

    def cloning() -> Cloning:
        return Cloning(demonstrations=shown, weight=0.3, rng=np.random.default_rng(3))

    noisy = objective.cloned(cloning())
    error = (noisy.noise - net(noisy.chunks, noisy.k, noisy.features[noisy.state])).square().sum((1, 2)).mean()
    expected = torch.cat([x.flatten() for x in torch.autograd.grad(0.3 * error, list(net.parameters()))])
    found = objective.gradient(draws, cloning()) - objective.gradient(draws)
    assert (found - expected).norm() < 1e-4 * expected.norm()


def test_meaningless_combinations_are_refused():
    with pytest.raises(ConfigError, match="no loser to scale"):
        run(FCPAConfig(guard="scale", objective="awr"))
    with pytest.raises(ConfigError, match="no demonstrations"):
        run(FCPAConfig(guard="bc"))


def test_a_nan_fails_and_leaves_the_weights_as_they_were():
    net = unet()
    before = flat(net)
    pairs = some_pairs()
    pairs.positives[0, 0, 0] = float("nan")
    _, update = run(FCPAConfig(), pairs, net)
    assert update.status == "failed"
    assert not update.changed
    assert torch.equal(flat(net), before)


def test_a_step_size_that_explodes_fails_and_leaves_the_weights_as_they_were():
    net = unet()
    before = flat(net)
    _, update = run(FCPAConfig(lr=1e30), net=net)
    assert update.status == "failed"
    assert "lower fcpa.lr" in update.note
    assert torch.equal(flat(net), before)


def test_cancellation_ends_it_between_two_passes():
    looks = []

    def cancelled() -> bool:
        looks.append(1)
        return len(looks) >= 7

    with pytest.raises(AdaptationCancelledError):
        run(FCPAConfig(steps=50), some_pairs(states=30, positives=8), cancelled=cancelled)
    assert len(looks) == 7


def test_it_looks_for_cancellation_before_every_small_batch_and_between_layers_on_the_way_back(monkeypatch):
    looks, rows, learnt_from = [], [], []
    run_ = FastUnet.run

    def counting(self, noisy, k, condition):
        (learnt_from if torch.is_grad_enabled() else rows).append(len(noisy))
        return run_(self, noisy, k, condition)

    monkeypatch.setattr(FastUnet, "run", counting)
    run(FCPAConfig(steps=2), some_pairs(states=20, positives=8), cancelled=lambda: bool(looks.append(1)))
    assert max(rows + learnt_from) <= preference.BATCH
    assert len(looks) >= len(rows) + 6 * len(learnt_from)
