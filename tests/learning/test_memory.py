"""An observation is encoded once, whoever asks: policy, critic, attribution, candidates; and never mistaken."""

import dataclasses
import gc
import weakref

import numpy as np
import pytest
import torch

from far_app.learning.critic import Critic, eyes_of
from far_app.learning.memory import FeatureMemory
from far_app.learning.policy import DiffusionPolicy
from far_app.learning.runtime import ActingPolicy
from far_app.methods import Ingredients, method
from far_app.methods.evidence import history
from tests.learning.small import observation, small_attempt, small_critic, small_policy
from tests.methods.test_methods import QUICK, adapt


class Counter:
    """Pictures that pass an encoder."""

    def __init__(self, network) -> None:
        self.pictures = 0
        for net in network.encoder.nets.values():
            for camera in net:
                camera.register_forward_hook(self.count)

    def count(self, camera, inputs, output) -> None:
        self.pictures += len(output)


def run(own_eyes: bool):
    """A method and its acting policy as an application puts them together, over an attempt with no V recorded."""
    network, memory = small_policy(), FeatureMemory()
    critic = small_critic(network)
    if own_eyes:
        critic = Critic(dataclasses.replace(critic.shape, own_eyes=True), eyes_of(network)).eval().requires_grad_(False)
    base = ActingPolicy(network, "base", critic, "arranged", memory=memory)
    counters = [Counter(n) for n in (network, *((critic.eyes,) if critic.eyes is not None else ()))]

    def act(net, version, steering=None):
        if version == "base":
            return base
        return ActingPolicy(net, version, critic, "arranged", steering, memory=memory, base=base)

    made = method("far", Ingredients(network=network, critic=critic, act=act, config=QUICK, memory=memory))
    return made, counters


@pytest.mark.parametrize("own_eyes", [False, True])
def test_after_an_attempt_only_its_last_observation_is_encoded(own_eyes):
    m, counters = run(own_eyes)
    attempt = small_attempt(40, values=False)
    for tick in range(40):
        m.policy.plan([history(attempt, tick, 2)], [tick], np.zeros((1, 8, 7), np.float32))
    before = [c.pictures for c in counters]
    assert before[0] < 2 * (40 + 2 * 8), "a frame that two ticks share was encoded twice"
    adaptation = adapt(m, attempt)
    assert adaptation.status == "adapted"
    assert np.isfinite(adaptation.values).all()
    shown = [c.pictures - b for c, b in zip(counters, before, strict=True)]
    seen_by_critic = shown[-1]
    assert seen_by_critic == 4, "two cameras, the last history's two frames"
    if own_eyes:
        assert shown[0] == 0


def test_an_adapted_version_finds_what_the_base_has_seen():
    m, (counter,) = run(own_eyes=False)
    attempt = small_attempt(40)
    adapt(m, attempt)
    m.policy.plan([history(attempt, 5, 2)], [5], np.zeros((1, 8, 7), np.float32))
    before = counter.pictures
    (chunk,) = m.policy.plan([history(attempt, 5, 2)], [5], np.zeros((1, 8, 7), np.float32))
    assert counter.pictures == before
    assert chunk.policy_version == "base+a1"


def test_what_the_policy_never_saw_is_learnt_from_through_its_engine(monkeypatch):
    """A policy that does not plan at every tick leaves states to attribution."""
    network = small_policy()
    critic, passes, made = small_critic(network), [], []
    base = ActingPolicy(network, "base", critic, "arranged")

    def encoder():
        made.append(1)
        return lambda histories: (passes.append(len(histories)), DiffusionPolicy.encode(network, histories))[1]

    m = method("far", Ingredients(
        network=network, critic=critic, config=QUICK, encoder=encoder,
        act=lambda net, version, steering=None: (
            base if version == "base" else ActingPolicy(net, version, critic, "arranged", base=base)
        ),
    ))  # fmt: skip
    monkeypatch.setattr(network, "encode", lambda histories: pytest.fail("encoded as it is written"))
    assert not made, "made before anything was to be learnt"
    attempt = small_attempt(40, values=False)
    assert np.isfinite(adapt(m, attempt).values).all()
    assert (sum(passes), made) == (41, [1])


def test_a_copy_knows_what_was_known_and_goes_its_own_way():
    memory, rng = FeatureMemory(), np.random.default_rng(0)
    first, second = [(observation(0, rng),)], [(observation(1, rng),)]
    memory.keep(first, torch.ones(1, 1))
    other = memory.copy()
    other.keep(second, torch.zeros(1, 1))
    assert other.known([*first, *second])
    assert memory.known(first)
    assert not memory.known(second)


def test_a_candidate_batch_needs_no_encoder():
    m, (counter,) = run(own_eyes=False)
    attempt = small_attempt(40)
    adapt(m, attempt)
    before = counter.pictures
    m.begin(5)
    adapt(m, attempt)
    assert counter.pictures == before, "the same attempt was encoded again"


def test_features_are_those_of_the_very_observations():
    """Equal addresses are not equal observations; other eyes are other features."""
    memory, rng = FeatureMemory(), np.random.default_rng(0)
    calls = []

    def encode(histories):
        calls.append(len(histories))
        return torch.tensor([[float(o.seq) for o in h] for h in histories])

    one = (observation(1, rng), observation(2, rng))
    assert memory.of([one, one], encode).tolist() == [[1.0, 2.0], [1.0, 2.0]]
    assert calls == [1], "the same history twice in a batch"
    assert memory.of([one], encode, eyes="critic").tolist() == [[1.0, 2.0]]
    assert calls == [1, 1]
    for seq in range(3, 40):  # new observations take the addresses of old ones
        h = (observation(seq, rng),)
        assert memory.of([h], encode).tolist() == [[float(seq)]]
        del h
        gc.collect()
    assert memory.of([one], encode).tolist() == [[1.0, 2.0]]


def test_what_was_seen_is_not_kept_alive_and_the_oldest_is_forgotten():
    memory, rng = FeatureMemory(kept=2), np.random.default_rng(0)
    histories = [(observation(i, rng),) for i in range(3)]
    memory.keep(histories, torch.zeros(3, 1))
    assert [memory.known([h]) for h in histories] == [False, True, True]
    alive = weakref.ref(histories[2][0])
    del histories
    gc.collect()
    assert alive() is None
