"""Every engine is the reference, on the weights it was asked for; one that is not is refused, said, and replaced."""

import copy
import dataclasses
import functools
import logging
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from far_app.errors import ConfigError, PolicyError
from far_app.learning.engines import ENGINES, Choice, Engine, EngineError, Entry, order_of, take
from far_app.learning.engines.cuda_graph import CudaGraphEngine
from far_app.learning.engines.openvino_unet import available
from far_app.learning.engines.reference import ReferenceEngine
from far_app.learning.engines.taking import check, probe
from far_app.learning.policy import DiffusionPolicy, preset
from far_app.learning.runtime import ActingPolicy
from far_app.protocols import PlanRequest
from far_app.session.planners import plan_one
from tests.learning.small import small_attempt, small_policy

needs_openvino = pytest.mark.skipif(not available(), reason="OpenVINO is not installed: pip install openvino")
needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA GPU here")
HISTORY = tuple(s.observation for s in small_attempt(2).steps)
NOISE = np.random.default_rng(0).standard_normal((1, 8, 7)).astype(np.float32)
ROUNDING = 1e-5
"""By which features of values up to 1 differ where a processor takes other kernels for another batch size (without
AVX-512: 1.2e-6)."""


def policy(encoder: str = "light", seed: int = 0, norm: str = "group", n_obs: int = 2) -> DiffusionPolicy:
    torch.manual_seed(seed)
    size = {"light": 16, "resnet18": 40, "none": 84}[encoder]
    config = dataclasses.replace(
        preset("state" if encoder == "none" else "quickstart", "lift"),
        encoder=encoder, image_size=size, widths=(16, 32), ddim_steps=4, norm=norm,
        n_obs=n_obs,
    )  # fmt: skip
    network = DiffusionPolicy(config).eval().requires_grad_(False)
    for module in network.encoder.modules():  # statistics that a trained network would have
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(std=0.1)
            module.running_var.uniform_(0.5, 2.0)
    return network


@functools.cache
def resnet_engine(n_obs: int = 2) -> tuple[DiffusionPolicy, Engine]:
    network = policy("resnet18", n_obs=n_obs)
    return network, ENGINES["openvino"].make(network, "v", False)


def moved(network: DiffusionPolicy, by: float = 0.05) -> DiffusionPolicy:
    """With other denoiser weights; the encoder is the same."""
    other = copy.deepcopy(network)
    with torch.no_grad():
        for parameter in other.denoiser.parameters():
            parameter.add_(by * torch.randn_like(parameter))
    return other


def on_this_machine() -> list[str]:
    return [n for n, e in ENGINES.items() if not e.unusable(small_policy())]


@pytest.mark.parametrize(
    "encoder,norm", [("light", "group"), ("resnet18", "group"), ("resnet18", "batch"), ("none", "group")]
)
@pytest.mark.parametrize("name", [n for n in ENGINES if n != "cuda-graph"])
def test_an_engine_is_the_reference_alone_in_a_batch_and_pushed(name, encoder, norm):
    network, entry = policy(encoder, norm=norm), ENGINES[name]
    if why := entry.unusable(network):
        pytest.skip(f"{name}: {why}")
    engine, reference = entry.make(network, "v", False), ReferenceEngine(network, "v")
    for batch in (1, 3, 10):
        histories, noise = probe(network, batch)
        expected, chunks = reference.plan(histories, noise)
        found = engine.plan(histories, noise)
        assert torch.allclose(found[0], expected, atol=max(entry.tolerance, ROUNDING))
        assert torch.allclose(found[1], chunks, atol=max(entry.tolerance, ROUNDING))
        assert torch.allclose(engine.encode(histories), expected, atol=max(entry.tolerance, ROUNDING))
        pushed = [e.sample(expected, noise, push=lambda clean: clean + 0.3) for e in (engine, reference)]
        assert torch.allclose(*pushed, atol=max(entry.tolerance, ROUNDING))
        assert not torch.allclose(pushed[1], chunks, atol=1e-2)


@pytest.mark.parametrize("encoder", ["light", "resnet18", "none"])
@pytest.mark.parametrize("dtype,tolerance", [(torch.float32, 1e-4), (torch.bfloat16, 5e-2)])
def test_the_cuda_program_run_eagerly_is_the_reference(encoder, dtype, tolerance):
    """Its static buffers, its precomputed FiLM and its low-precision encoder, without a GPU."""
    network = policy(encoder)
    engine, reference = CudaGraphEngine(network, "v", dtype), ReferenceEngine(network, "v")
    check(engine, reference, tolerance, batch=3)
    first, second = (probe(network, 2), (list(reversed(probe(network, 2)[0])), torch.zeros(2, 8, 7)))
    kept = engine.plan(*first)
    engine.plan(*second)  # the same buffers
    assert torch.allclose(kept[1], reference.plan(*first)[1], atol=tolerance), "a later plan overwrote an earlier one"
    assert torch.allclose(engine.plan(*second)[1], reference.plan(*second)[1], atol=tolerance)
    other = moved(network)
    check(engine.adapted(other, "v2"), ReferenceEngine(other, "v2"), tolerance, denoiser_only=True)
    check(engine, reference, tolerance)
    histories = probe(network, 5)[0]
    assert torch.allclose(engine.another_encoder()(histories), engine.encode(histories), atol=ROUNDING)


@pytest.mark.parametrize("encoder", ["light", "resnet18", "none"])
@pytest.mark.parametrize("name", [n for n in ENGINES if n != "cuda-graph"])
def test_learning_sees_what_the_policy_sees_while_it_acts(name, encoder):
    network, entry = policy(encoder), ENGINES[name]
    if why := entry.unusable(network):
        pytest.skip(f"{name}: {why}")
    engine, tolerance = entry.make(network, "v", False), max(entry.tolerance, ROUNDING)
    learners = engine.another_encoder()
    seen, acted = probe(network, 12)[0], probe(network, 24)[0][12:]
    noise = torch.zeros(1, 8, 7)
    with ThreadPoolExecutor() as pool:
        learnt = pool.submit(lambda: torch.cat([learners([h]) for h in seen]))
        features = torch.cat([engine.plan([h], noise)[0] for h in acted])
    assert torch.allclose(learnt.result(), network.encode(seen), atol=tolerance)
    assert torch.allclose(features, network.encode(acted), atol=tolerance)


@needs_openvino
@settings(max_examples=8, deadline=None)
@given(
    n_obs=st.integers(1, 3), steps=st.lists(st.sampled_from([1, 1, 1, 0, 2]), min_size=3, max_size=8),
    batches=st.lists(st.sampled_from([1, 1, 1, 2]), min_size=8, max_size=8),
)  # fmt: skip
def test_what_was_looked_at_ahead_is_what_the_next_tick_sees(n_obs, steps, batches):
    """Whatever comes next: the next tick, the same one again, one that was skipped, several robots."""
    network, engine = resnet_engine(n_obs)
    frames, at = [o for (o, *_) in probe(network, 40)[0]], n_obs - 1
    for step, batch in zip(steps, batches, strict=False):
        at += step
        histories = [tuple(frames[at + 17 * robot - n_obs + 1 : at + 17 * robot + 1]) for robot in range(batch)]
        assert torch.allclose(engine.encode(histories), network.encode(histories), atol=1e-4)


@needs_openvino
def test_an_older_frame_is_looked_at_while_the_chain_runs(monkeypatch):
    network, engine = resnet_engine()
    look, waited = engine.frames.camera_features, []
    monkeypatch.setattr(
        engine.frames, "camera_features", lambda looks: waited.extend(place for _, place, _ in looks) or look(looks)
    )
    frames, waits = [o for (o, *_) in probe(network, 8)[0]], []
    for at in (1, 2, 3, 4, 6, 7):
        waited.clear()
        engine.encode([tuple(frames[at - 1 : at + 1])])
        waits.append(sorted(waited))
    cold, ahead = [0, 0, 1, 1], [1, 1]
    assert waits == [cold, cold, ahead, ahead, cold, cold]


@needs_cuda
@pytest.mark.parametrize("encoder", ["light", "resnet18", "none"])
def test_a_captured_graph_is_the_reference(encoder):
    network = policy(encoder).to("cuda")
    engine, reference = CudaGraphEngine(network, "v"), ReferenceEngine(network, "v")
    check(engine, reference, ENGINES["cuda-graph"].tolerance, batch=4)
    other = moved(network)
    check(engine.adapted(other, "v2"), ReferenceEngine(other, "v2"), ENGINES["cuda-graph"].tolerance, batch=4)
    check(engine, reference, ENGINES["cuda-graph"].tolerance)


@pytest.mark.parametrize("name", on_this_machine())
@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 1000), batch=st.integers(1, 9))
def test_after_an_adaptation_each_version_runs_its_own_weights(name, seed, batch):
    """Graphs are shared by all weights of an architecture; each engine reads its own."""
    base = policy(seed=seed % 3)
    torch.manual_seed(seed)
    other, tolerance = moved(base), max(ENGINES[name].tolerance, ROUNDING)
    before = ENGINES[name].make(base, "base", False)
    after = before.adapted(other, "base+a1")
    features, noise = torch.randn(batch, base.feature_dim), torch.randn(batch, 8, 7)
    for engine, network in ((after, other), (before, base), (after, other)):
        expected = ReferenceEngine(network, "").sample(features, noise)
        assert torch.allclose(engine.sample(features, noise), expected, atol=tolerance)
    assert (before.version, after.version) == ("base", "base+a1")


class Stubborn(ReferenceEngine):
    """Goes on with the weights it has, whatever it is asked."""

    name = "stubborn"

    def adapted(self, network, version):
        return self


class Lying(Stubborn):
    """… and says it has the new ones."""

    def adapted(self, network, version):
        liar = Lying(self.network, version)
        return liar


class Wrong(ReferenceEngine):
    def sample(self, features, noise, push=None):
        return super().sample(features, noise, push) + 1e-3


def unbuildable(network, version, each_alone):
    raise EngineError("no such instruction")


def entry(make, name: str = "stubborn") -> Entry:
    return Entry(name=name, summary="", make=make, unusable=lambda network: "", tolerance=1e-4)


@pytest.mark.parametrize("kind,why", [(Stubborn, "weights of version base, not of base.a1"), (Lying, "differs")])
def test_a_retry_never_runs_on_old_weights(kind, why, monkeypatch):
    monkeypatch.setitem(ENGINES, "stubborn", entry(kind))
    base, choice = small_policy(), Choice(order=("stubborn", "arranged"))
    other = moved(base)
    before = take(base, "base", choice)
    assert before.report.name == "stubborn"
    after = take(other, "base+a1", choice, base=before)
    assert after.report.name == "arranged"
    assert len(after.report.refused) == 1
    with pytest.raises(EngineError, match=why):
        check(before.engine.adapted(other, "base+a1"), ReferenceEngine(other, "base+a1"), 1e-4, denoiser_only=True)


def test_a_chunk_of_another_version_than_the_policy_that_was_asked_is_refused():
    acting = ActingPolicy(small_policy(), "base", engine="torch")
    acting.version = "base+a1"
    with pytest.raises(PolicyError, match=r"policy base\+a1 was asked at tick 4.*weights of base answered"):
        plan_one(PlanRequest(history=HISTORY, tick=4, noise_key=(0, 1, 4), policy=acting))


@pytest.mark.parametrize("make,why", [(Wrong, "chunk differs from the reference by 0.001"), (unbuildable, "no such")])
def test_an_engine_that_fails_is_refused_once_with_its_error_and_the_next_is_taken(make, why, monkeypatch, caplog):
    monkeypatch.setitem(ENGINES, "bad", entry(make, "bad"))
    base, choice = small_policy(), Choice(order=("bad", "arranged", "torch"), why="measured")
    with caplog.at_level(logging.WARNING):
        taken = take(base, "base", choice)
        again = take(moved(base), "base+a1", choice, base=taken)
    assert (taken.report.name, again.report.name) == ("arranged", "arranged")
    assert why in taken.report.refused[0]
    assert again.report.refused == taken.report.refused
    assert len([r for r in caplog.records if "bad" in r.getMessage()]) == 1


def test_with_every_engine_refused_the_reference_acts(monkeypatch):
    monkeypatch.setitem(ENGINES, "bad", entry(Wrong, "bad"))
    network = small_policy()
    acting = ActingPolicy(network, "base", engine=Choice(order=("bad",)))
    assert acting.runs_on.name == "torch"
    (chunk,) = acting.plan([HISTORY], [1], NOISE)
    expected = network.sample(network.encode([HISTORY]), torch.from_numpy(NOISE))[0]
    assert np.array_equal(chunk.actions, expected.numpy())


def test_what_was_asked_for_and_cannot_run_says_what_to_do(monkeypatch):
    with pytest.raises(ConfigError, match="unknown engine 'gpu'; choose one of: auto, cuda-graph, openvino"):
        order_of("gpu", small_policy())
    with pytest.raises(ConfigError, match="engine cuda-graph was asked for, but the policy is on cpu"):
        order_of("cuda-graph", small_policy())
    monkeypatch.setattr("far_app.learning.engines.openvino_engine.available", lambda: False)
    with pytest.raises(ConfigError, match="pip install openvino"):
        order_of("openvino", small_policy())
    assert order_of("auto", small_policy()).order == ("arranged", "torch")


@needs_openvino
def test_lower_precision_is_never_taken_by_itself():
    assert "openvino-bf16" not in order_of("auto", small_policy()).order
    assert order_of("openvino-bf16", small_policy()).order[:2] == ("openvino-bf16", "openvino")
