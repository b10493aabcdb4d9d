"""The fastest engine is measured once for a machine and remembered; what cannot be measured or kept does no harm."""

import dataclasses
import json

import pytest

from far_app.learning.engines import ENGINES, EngineError, Entry, choice, order_of
from far_app.learning.engines.reference import ReferenceEngine
from tests.learning.small import small_policy


def unbuildable(network, version, each_alone):
    raise EngineError("no such instruction")


@pytest.fixture
def measurements(monkeypatch):
    """Engines that stand in the wrong order, and what they took; the clock is not asked."""
    milliseconds, taken = {"slow": 50.0, "arranged": 2.0, "torch": 7.0}, []
    everything = dict(ENGINES)
    ENGINES.clear()
    for name, make in (("slow", slow), ("broken", unbuildable)):
        ENGINES[name] = Entry(name=name, summary="", make=make, unusable=lambda network: "", tolerance=1e-4)
    ENGINES.update(arranged=everything["arranged"], torch=everything["torch"])

    def measured(engines, network):
        taken.extend(engines)
        return {name: [milliseconds[name]] for name in engines}

    monkeypatch.setattr(choice, "taking_turns", measured)
    yield taken
    ENGINES.clear()
    ENGINES.update(everything)


def slow(network, version, each_alone):
    engine = ReferenceEngine(network, version, each_alone)
    engine.name = "slow"
    return engine


def test_the_fastest_comes_first_and_is_measured_once(measurements, tmp_path):
    network, file = small_policy(), tmp_path / "far" / "engines.json"
    assert order_of("auto", network).order[0] == "slow"
    first = choice.fastest(network, file=file)
    assert first.order == ("arranged", "torch", "slow", "broken")
    assert first.why == "fastest here, ms a chunk: arranged 2.0, torch 7.0, slow 50.0"
    assert measurements == ["slow", "arranged", "torch"]
    assert choice.fastest(network, file=file) == first
    assert len(measurements) == 3, "measured again"


def test_every_engine_of_this_machine_can_be_measured(tmp_path):
    network = small_policy()
    found = choice.measured(network, order_of("auto", network).order, threads=1)
    assert set(found) == set(order_of("auto", network).order)
    assert min(found.values()) > 0


def test_another_network_or_thread_count_is_measured_by_itself(measurements, tmp_path):
    file, network = tmp_path / "engines.json", small_policy()
    other = small_policy()
    other.config = dataclasses.replace(other.config, ddim_steps=2)
    for known, (net, threads) in enumerate(((network, 1), (network, 2), (other, 1)), 1):
        choice.fastest(net, threads, file)
        assert len(json.loads(file.read_text())) == known


def test_a_damaged_file_is_measured_anew_and_an_unwritable_one_is_done_without(measurements, tmp_path):
    file = tmp_path / "engines.json"
    file.write_text("{")
    assert choice.fastest(small_policy(), file=file).order[0] == "arranged"
    occupied = tmp_path / "a file"
    occupied.write_text("")
    assert choice.fastest(small_policy(), file=occupied / "engines.json") == order_of("auto", small_policy())
