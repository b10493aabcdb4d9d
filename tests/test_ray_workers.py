"""A Ray cluster finds what one worker finds, and a worker killed half-way costs nothing."""

import dataclasses
import os
import signal
import sys
import time
from pathlib import Path

import pytest

from far_app.errors import ConfigError, FarError
from far_app.evaluation import Arm, EvaluationPlan, evaluate, read_results
from far_app.ray_workers import ray_workers

PLAN = EvaluationPlan(
    task="lift", rig="twin", policy="p", critic="c", first_scene=100, scenes=8, max_attempts=2,
    arms=tuple(Arm(name=n, method=n) for n in ("nr", "far")),
)  # fmt: skip


def begin(plan):
    if plan.fingerprint() != PLAN.fingerprint():
        raise ConfigError("another plan arrived")


def work(block):
    for scene, done in block:
        for arm in ("nr", "far"):
            if arm not in done:
                yield {"arm": arm, "scene": scene, "success": scene % 3 == 0, "attempts": 1 + scene % 2}


def killed_once(block):
    """Dies in the middle of scene 101, the first time."""
    mark = Path(os.environ["FAR_TEST_MARK"])
    for record in work(block):
        yield record
        if record["scene"] == 101 and record["arm"] == "nr" and not mark.exists():
            mark.touch()
            time.sleep(1.0)
            os.kill(os.getpid(), signal.SIGKILL)


def always_killed(block):
    os.kill(os.getpid(), signal.SIGKILL)
    yield from work(block)


@pytest.fixture
def importable(monkeypatch, tmp_path):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parents[1]), *sys.path]))
    monkeypatch.setenv("FAR_TEST_MARK", str(tmp_path / "mark"))


@pytest.mark.slow
def test_a_worker_killed_half_way_costs_nothing(tmp_path, importable):
    evaluate(tmp_path / "one", PLAN, 1, lambda record: None, begin, work)
    told = []
    evaluate(tmp_path / "ray", PLAN, 2, told.append, begin, killed_once, ray_workers())
    assert (tmp_path / "mark").exists(), "a worker was killed"

    def sorted_lines(folder):
        return sorted(map(str, read_results(tmp_path / folder / "episodes.jsonl")))

    assert sorted_lines("ray") == sorted_lines("one")
    assert len(told) == 16
    other = dataclasses.replace(PLAN, max_attempts=3)
    with pytest.raises(ConfigError, match="another plan arrived"):
        evaluate(tmp_path / "other", other, 2, lambda record: None, begin, work, ray_workers())
    with pytest.raises(FarError, match="3 workers died over scenes 10"):
        evaluate(tmp_path / "never", PLAN, 2, lambda record: None, begin, always_killed, ray_workers())


@pytest.mark.slow
def test_a_cluster_that_does_not_answer_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"no Ray cluster answers at 127\.0\.0\.1:1"):
        evaluate(tmp_path, PLAN, 2, lambda record: None, begin, work, ray_workers("127.0.0.1:1"))


def test_without_ray_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"pip install 'ray"):
        ray_workers()
