"""Methods by name: what each does with a failure, restores exactly, and leaves when it is cancelled."""

import copy
import dataclasses
import json
import threading

import numpy as np
import pytest
import torch

from far_app.config import AttributionConfig, FCPAConfig, PairsConfig, PerturbationConfig, RetryConfig
from far_app.errors import ConfigError
from far_app.learning.apart.here import WorkHere
from far_app.learning.runtime import ActingPolicy
from far_app.learning.trainable import plain, trainable
from far_app.methods import METHODS, Ingredients, method
from far_app.methods.evidence import sent_chunks
from far_app.protocols import Method
from far_app.recording.codec import codec, decode
from far_app.types import Adaptation, FlagCorrection
from tests.learning.small import small_attempt, small_critic, small_policy
from tests.methods.making import QUICK, adapt, made, plan


@pytest.mark.parametrize("guard", ["none", "bc", "scale"])
def test_a_lesson_is_the_same_on_any_number_of_threads(guard):
    config = dataclasses.replace(QUICK, fcpa=dataclasses.replace(QUICK.fcpa, guard=guard))

    def learnt(threads: int) -> tuple[list[bytes], tuple]:
        m = made("fcpa", config, small_policy())
        m.work = WorkHere(threads)
        lesson = adapt(m)
        assert lesson.status == "adapted"
        assert threading.active_count() == before
        return [tensor.tobytes() for tensor in m.adapted.tensors.values()], lesson.history

    before = threading.active_count()
    assert learnt(1) == learnt(2) == learnt(3)


@pytest.mark.parametrize("name", METHODS)
def test_every_method_is_a_method(name):
    m = made(name)
    assert isinstance(m, Method)
    assert m.name == name
    m.begin(3)
    assert m.policy.version == "base"


@pytest.mark.parametrize("name,learns,explores", [
    ("dp", False, False), ("nr", False, False), ("perturb", False, True), ("fcpa", True, False), ("far", True, True),
])  # fmt: skip
def test_what_each_method_does_with_a_failure(name, learns, explores):
    m = made(name)
    m.begin(5)
    before = plan(m)
    adaptation = adapt(m)
    assert (adaptation.status == "adapted") == learns
    assert m.policy.version == ("base+a1" if learns else "base") == adaptation.version
    assert np.array_equal(plan(m), before) != learns
    delta = m.perturb(2, 5)
    assert any(delta(t).any() for t in range(50)) == explores
    assert not any(m.perturb(1, 5)(t).any() for t in range(50))


def test_an_adaptation_reports_its_evidence():
    m = made("far")
    m.begin(5)
    attempt = small_attempt(ticks=40)
    news = []
    adaptation = m.adapt(attempt, lambda: False, news.append)
    assert len(adaptation.values) == 41
    assert np.isfinite(adaptation.values).all()
    assert [s.value for s in attempt.steps] == adaptation.values[:40].tolist()
    assert np.allclose(adaptation.value_changes, adaptation.values[8:] - adaptation.values[:-8])
    assert len(adaptation.flagged) == 4
    assert all(adaptation.value_changes[t] <= adaptation.threshold for t in adaptation.flagged)
    assert adaptation.pairs == 12
    attributed, paired, *steps = news
    assert (attributed.flagged, attributed.pairs) == (adaptation.flagged, 0), "flags are told before pairs are sought"
    assert (paired.flagged, paired.pairs) == (adaptation.flagged, 12)
    assert tuple(steps) == adaptation.history
    assert set(adaptation.seconds) == {"attribution", "encoding", "candidates", "pairs", "update", "engine"}


def test_an_adaptation_keeps_its_positives_best_first_within_a_recording():
    m = made("far")
    m.begin(5)
    adaptation = adapt(m, small_attempt(ticks=40))
    assert tuple(c.tick for c in adaptation.contrasts) == adaptation.flagged
    assert sum(len(c.positives) for c in adaptation.contrasts) == adaptation.pairs
    assert all((np.diff(c.q) <= 0).all() and (c.distance > 0).all() for c in adaptation.contrasts)
    again = decode(Adaptation, json.loads(json.dumps(codec(Adaptation).encode(adaptation))), "a round trip")
    assert np.array_equal(again.contrasts[0].positives, adaptation.contrasts[0].positives)


def test_the_operators_words_decide_what_is_learnt_from():
    m = made("far")
    m.begin(5)
    attempt = small_attempt(ticks=40)
    flagged = adapt(made("far"), attempt).flagged
    words = (FlagCorrection(tick=flagged[0], flagged=False), FlagCorrection(tick=30, flagged=True))
    adaptation = adapt(m, dataclasses.replace(attempt, corrections=words))
    assert set(adaptation.flagged) == (set(flagged) - {flagged[0]}) | {30}
    assert adaptation.corrections == words


def test_missing_values_are_computed_from_the_critic():
    m = made("far")
    m.begin(5)
    attempt = small_attempt(values=False)
    found = adapt(m, attempt).values
    histories = [(attempt.steps[max(0, t - 1)].observation, attempt.steps[t].observation) for t in range(40)]
    histories.append((attempt.steps[-1].observation, attempt.final))
    expected = m.critic.value(m.base.encode(histories)).numpy()
    assert np.allclose(found, expected, atol=1e-5)


def test_begin_brings_the_base_back_bit_for_bit():
    network = small_policy()
    weights = copy.deepcopy(network.state_dict())
    m = made("far", network=network)
    m.begin(5)
    first = plan(m)
    adapt(m)
    adapt(m, small_attempt(index=2))
    assert m.policy.version == "base+a2"
    m.begin(6)
    assert m.policy.version == "base"
    assert np.array_equal(plan(m), first)
    assert all(torch.equal(v, weights[k]) for k, v in network.state_dict().items())


def test_only_the_denoiser_moves():
    m = made("fcpa")
    m.begin(5)
    adapt(m)
    acting, base = m.acting.state_dict(), m.base.state_dict()
    moved = {k for k in base if not torch.equal(acting[k], base[k])}
    assert moved
    assert all(k.startswith("denoiser.") for k in moved)
    assert not any(p.requires_grad for p in m.acting.parameters())


def test_the_same_scene_and_attempt_teach_the_same_lesson():
    """Also in a fresh method object, and whatever happened in other trials."""
    one, two = made("far"), made("fcpa")
    one.begin(9)
    adapt(one, small_attempt(scene_seed=9))
    one.begin(5)
    two.begin(5)
    adapt(one)
    adapt(two)
    assert np.array_equal(plan(one), plan(two))


def test_the_plain_form_teaches_the_same_lesson():
    """Candidates, pairs, errors and weights; the networks are small and the steps so too, for Adam divides by √v."""
    config = dataclasses.replace(QUICK, fcpa=dataclasses.replace(QUICK.fcpa, lr=1e-4))
    lessons = []
    for arrange in (trainable, plain):
        network = small_policy()
        critic = small_critic(network)
        m = method("fcpa", Ingredients(
            network=network, critic=critic, config=config, work=lambda arrange=arrange: WorkHere(arrange=arrange),
            act=lambda net, version, steering=None: ActingPolicy(net, version, None, "torch", steering),
        ))  # fmt: skip
        lessons.append((adapt(m), plan(m)))
    (fast, fast_chunk), (slow, slow_chunk) = lessons
    assert fast.pairs == slow.pairs > 0
    for a, b in zip(fast.contrasts, slow.contrasts, strict=True):
        assert np.allclose(a.positives, b.positives, atol=1e-4)
    for a, b in zip(fast.history, slow.history, strict=True):
        assert np.allclose((a.loss, a.winner_error, a.loser_error), (b.loss, b.winner_error, b.loser_error), rtol=1e-3)
    assert np.allclose(fast_chunk, slow_chunk, atol=1e-3)
    assert not np.allclose(fast_chunk, plan(made("nr")), atol=1e-3)


def test_a_hedged_lesson_that_failed_is_withdrawn_for_one_attempt_and_remembered():
    m = made("fcpa", RetryConfig(pairs=QUICK.pairs, fcpa=FCPAConfig(steps=2, lr=1e-3, accumulate=False, hedge=True)))
    m.begin(5)
    base = plan(m)
    first, second, third = (adapt(m, small_attempt(index=i)) for i in (1, 2, 3))
    assert [a.status for a in (first, second, third)] == ["adapted", "withdrawn", "adapted"]
    assert [a.version for a in (first, second, third)] == ["base+a1", "base", "base+a2"]
    assert second.flagged and not np.array_equal(plan(m), base)
    assert sum(len(r) for r in m.rounds) == first.pairs + third.pairs
    with pytest.raises(ConfigError, match=r"fcpa.accumulate is True, must be false when fcpa.hedge"):
        FCPAConfig(hedge=True)


def test_adaptations_accumulate_or_restart_with_all_pairs():
    def after(accumulate: bool, attempts: list[int]):
        config = RetryConfig(pairs=QUICK.pairs, fcpa=FCPAConfig(steps=2, lr=1e-3, accumulate=accumulate))
        m = made("fcpa", config)
        m.begin(5)
        done = [adapt(m, small_attempt(index=i)) for i in attempts]
        return m, done

    accumulated, (_, second) = after(True, [1, 2])
    restarted, (_, again) = after(False, [1, 2])
    once, (only,) = after(False, [1])
    assert sum(len(r) for r in accumulated.rounds) == second.pairs + only.pairs
    assert again.pairs == second.pairs
    assert restarted.policy.version == "base+a2"
    assert len({plan(m).tobytes() for m in (accumulated, restarted, once)}) == 3
    # a restart begins at the base policy's error on the pairs of the first round and the second
    assert again.history[0].winner_error != second.history[0].winner_error


def test_candidates_that_explore_teach_another_lesson():
    def lesson(explore: float):
        m = made("fcpa", dataclasses.replace(QUICK, pairs=dataclasses.replace(QUICK.pairs, explore=explore)))
        m.begin(5)
        adapt(m)
        (pairs,) = m.rounds
        return pairs.positives.numpy().tobytes(), plan(m).tobytes()

    assert all(there != here for there, here in zip(lesson(0.5), lesson(0.0), strict=True))
    assert lesson(0.5) == lesson(0.5)


def test_a_cancelled_adaptation_changes_nothing():
    m = made("far")
    m.begin(5)
    before = plan(m)
    looks = []

    def cancelled() -> bool:
        looks.append(1)
        return len(looks) > 12

    adaptation = adapt(m, cancelled=cancelled)
    assert adaptation.status == "cancelled"
    assert adaptation.version == m.policy.version == "base"
    assert np.array_equal(plan(m), before)
    assert len(looks) < 20
    assert adaptation.flagged


def test_an_adaptation_that_outlives_its_trial_does_not_reach_the_next():
    m = made("far")
    m.begin(5)
    reached, go_on = threading.Event(), threading.Event()

    def cancelled() -> bool:
        reached.set()
        go_on.wait(5)
        return False

    found = []
    thread = threading.Thread(target=lambda: found.append(adapt(m, cancelled=cancelled)))
    thread.start()
    reached.wait(5)
    m.begin(6)
    go_on.set()
    thread.join(20)
    assert found[0].status == "cancelled"
    assert m.policy.version == "base"


def test_states_without_a_candidate_give_an_empty_adaptation():
    config = RetryConfig(pairs=PairsConfig(candidates=4, positives=2, d_max=1e-6, on_empty="skip"))
    m = made("far", config)
    m.begin(5)
    adaptation = adapt(m)
    assert adaptation.status == "empty"
    assert adaptation.empty_states == len(adaptation.flagged) == 4
    assert adaptation.version == m.policy.version == "base"


def test_an_attempt_shorter_than_a_chunk_teaches_nothing():
    m = made("far")
    m.begin(5)
    adaptation = adapt(m, small_attempt(ticks=6))
    assert adaptation.status == "empty"
    assert len(adaptation.value_changes) == 0


def test_a_broken_policy_fails_with_a_reason_and_changes_nothing():
    network = small_policy()
    with torch.no_grad():
        next(iter(network.denoiser.parameters())).fill_(float("nan"))
    m = made("far", network=network)
    m.begin(5)
    adaptation = adapt(m)
    assert adaptation.status == "failed"
    assert "non-finite" in adaptation.note
    assert m.policy.version == "base"


def test_an_unacknowledged_tick_counts_as_commanded():
    attempt = small_attempt()
    lost = dataclasses.replace(attempt.steps[3], sent=np.full(7, np.nan))
    attempt = dataclasses.replace(attempt, steps=(*attempt.steps[:3], lost, *attempt.steps[4:]))
    chunk = sent_chunks(attempt, [0], 8)[0]
    assert np.allclose(chunk[3], lost.commanded, atol=1e-6)
    assert np.isfinite(chunk).all()


def test_awr_learns_from_every_whole_chunk():
    config = RetryConfig(fcpa=FCPAConfig(objective="awr", steps=2), attribution=AttributionConfig())
    m = made("fcpa", config)
    m.begin(5)
    adaptation = adapt(m)
    assert adaptation.pairs == 33
    assert adaptation.status == "adapted"


def test_unknown_names_list_the_choices():
    with pytest.raises(ConfigError, match="dp, nr, perturb, fcpa, far"):
        made("fcap")


def test_learning_without_a_critic_is_refused_at_once():
    network = small_policy()
    with pytest.raises(ConfigError, match="needs a critic"):
        method("far", Ingredients(network=network, critic=None, act=lambda *given: None))
    assert method("nr", Ingredients(network=network, critic=None, act=lambda *given: None)).name == "nr"


def test_the_perturbation_follows_the_configuration():
    m = made("far", RetryConfig(perturbation=PerturbationConfig(kind="smoothed", dims=(0,), probability=1.0)))
    delta = m.perturb(2, 0)
    assert all(delta(t)[0] != 0 and not delta(t)[1:].any() for t in range(10))
