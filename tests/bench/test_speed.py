"""Benchmarks of engines and adaptations compare like with like, in one run."""

import pytest

from far_app.bench import adapt, adapt_growth, infer
from far_app.bench.evaluate import EvaluateOptions, scaling
from far_app.cli.lockstep_twin import LANES
from far_app.config import PairsConfig, RetryConfig
from far_app.learning.engines import ENGINES
from tests.learning.small import small_critic, small_policy


def test_the_plain_rounds_come_evenly_among_the_fast_ones():
    order = adapt.turns(6, 2)
    assert order.count("fast") == 6 and order.count("plain") == 2
    assert order.index("plain") > 0
    assert "plain" in order[:4] and "plain" in order[3:]
    assert adapt.turns(3, 0) == ["fast"] * 3


def test_every_engine_that_runs_here_has_a_row_against_torch():
    options = infer.InferOptions(presets=("state",), calls=2, growth="")
    report = infer.measure(options)
    network = small_policy()
    here = {n for n, e in ENGINES.items() if not e.unusable(network)} - {"openvino-bf16"}  # no cameras to lower
    assert {r["engine"] for r in report["chunks"]} == here
    assert (report["chunks"][0]["engine"], report["chunks"][0]["speedup"]) == ("torch", 1.0)
    assert all(r["calls"] == 2 and r["preset"] == "state" and r["replans"] >= 1 for r in report["chunks"])
    assert infer.table(report).count("\n") == 1 + len(here)


def test_all_policies_see_the_same_histories_and_noise():
    seen = {"a": [], "b": []}

    class Watching:
        def __init__(self, name):
            self.name, self.spec = name, small_policy().spec()

        def plan(self, histories, ticks, noise):
            seen[self.name].append(([tuple(map(id, h)) for h in histories], noise.tobytes()))

    spent = infer.milliseconds({n: Watching(n) for n in seen}, calls=3, batch=2)
    assert seen["a"] == seen["b"]
    assert [len(s) for s in spent.values()] == [3, 3]
    assert len({noise for _, noise in seen["a"]}) == 3 + infer.WARM_UP, "every call sees something new"


def test_an_attempt_of_noise_is_one_that_can_be_learnt_from():
    network = small_policy()
    attempt = adapt_growth.failed_attempt(network, 40)
    retry = RetryConfig(pairs=PairsConfig(candidates=16, d_max=100.0))
    _, stages = adapt_growth.adapted_in(network, small_critic(network), retry, attempt)
    assert {"attribution", "encoding", "candidates", "pairs", "update", "engine"} <= set(stages)


@pytest.mark.slow
def test_two_processes_of_lockstep_trials_run_as_many_ticks_each_as_one():
    options = EvaluateOptions(rounds=1, ticks=2)
    row = scaling("state", options)
    assert row.repeats == 3 * LANES * options.ticks, "one alone, then two at once"
    assert row.target is not None and row.plain and row.fast > 0
