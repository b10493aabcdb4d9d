"""The evaluation keeps what it has, refuses to mix, and runs a shared first attempt once."""

import dataclasses
import gzip
import json
import os
import signal
import time

import pytest

from far_app.cli.evaluate import main as evaluate_command
from far_app.cli.study import main as study_command
from far_app.config import FCPAConfig, RetryConfig
from far_app.errors import ConfigError, FarError
from far_app.evaluation import Arm, EvaluationPlan, differences, evaluate, read_arms_file, read_results, run_scenes
from far_app.types import Attempt, Judge, Outcome, Trial

PLAN = EvaluationPlan(
    task="lift", rig="twin", policy="p", critic="c", first_scene=100, scenes=3, max_attempts=2,
    arms=tuple(Arm(name=n, method=n, retry=RetryConfig()) for n in ("nr", "far")),
)  # fmt: skip
BEGUN: list[str] = []
WORKED: list[int] = []


def begin(plan):
    BEGUN.append(plan.task)


def work(block):
    for scene, done in block:
        WORKED.append(scene)
        for arm in ("nr", "far"):
            if arm not in done:
                yield {"arm": arm, "scene": scene, "success": True, "attempts": 1}


def test_a_second_start_does_only_what_is_missing(tmp_path):
    WORKED.clear()
    evaluate(tmp_path, PLAN, 1, lambda record: None, begin, work)
    assert sorted(WORKED) == [100, 101, 102]
    lines = (tmp_path / "episodes.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "episodes.jsonl").write_text("".join(lines[:-1]) + lines[-1][:10])  # a killed run's torn line
    WORKED.clear()
    evaluate(tmp_path, PLAN, 1, lambda record: None, begin, work)
    assert WORKED == [102]
    found = {(r["scene"], r["arm"]) for r in read_results(tmp_path / "episodes.jsonl")}
    assert found == {(s, a) for s in (100, 101, 102) for a in ("nr", "far")}


def test_committed_results_are_read_packed_and_go_on_from_there(tmp_path):
    evaluate(tmp_path, dataclasses.replace(PLAN, scenes=2), 1, lambda record: None, begin, work)
    results = tmp_path / "episodes.jsonl"
    before = read_results(results)
    (tmp_path / "episodes.jsonl.gz").write_bytes(gzip.compress(results.read_bytes()))
    results.unlink()
    assert read_results(results) == before
    WORKED.clear()
    evaluate(tmp_path, PLAN, 1, lambda record: None, begin, work)
    assert WORKED == [102]
    assert read_results(results)[: len(before)] == before


def killed_in_scene_101(block):
    for record in work(block):
        if record["scene"] == 101:
            time.sleep(1.0)  # what was told before is on its way
            os.kill(os.getpid(), signal.SIGKILL)
        yield record


@pytest.mark.slow
def test_two_workers_find_the_same_and_a_killed_one_costs_no_finished_episode(tmp_path):
    with pytest.raises(FarError, match="a worker was killed; every finished episode is kept"):
        evaluate(tmp_path, PLAN, 2, lambda record: None, begin, killed_in_scene_101)
    assert {r["scene"] for r in read_results(tmp_path / "episodes.jsonl")} >= {100}
    evaluate(tmp_path, PLAN, 2, lambda record: None, begin, work)
    found = sorted((r["scene"], r["arm"]) for r in read_results(tmp_path / "episodes.jsonl"))
    assert found == sorted((s, a) for s in (100, 101, 102) for a in ("nr", "far")), "nothing lost, nothing twice"


def begin_without_a_policy(plan):
    raise ConfigError(f"no policy at {plan.policy}; train one first")


def fails_in_scene_100(block):
    for record in work(block):
        if record["scene"] == 100:
            raise FarError("scene 100 cannot be drawn")
        time.sleep(0.2)
        yield record


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize(
    "begin_, work_, why",
    [(begin_without_a_policy, work, "no policy at p"), (begin, fails_in_scene_100, "scene 100 cannot be drawn")],
)
def test_what_a_worker_cannot_do_is_told_in_its_own_words(tmp_path, begin_, work_, why, workers):
    plan = dataclasses.replace(PLAN, scenes=500)
    with pytest.raises(FarError, match=why):
        evaluate(tmp_path, plan, workers, lambda record: None, begin_, work_)
    assert len(read_results(tmp_path / "episodes.jsonl")) < 500, "the others do not go on to the end"


def test_an_unknown_method_is_refused_before_anything_is_made(tmp_path):
    study = tmp_path / "s.toml"
    study.write_text(
        'rig = "panda"\npreset = "state"\nseeds = [0]\nscenes = 1\nmax_attempts = 2\n[[task]]\nname = "lift"\n'
        'demonstrations = 1\niterations = 1\n[[arm]]\nname = "mine"\nmethod = "nope"\n'
    )
    for command, words in ((evaluate_command, ["--methods", "nope"]), (study_command, [str(study)])):
        with pytest.raises(ConfigError, match="unknown method 'nope'; choose one of: dp, nr"):
            command([*words, "--out", str(tmp_path / "out")])
        assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_policy_alone_has_one_attempt_beside_methods_that_retry(tmp_path):
    """Scene 20001: the shipped model does not solve it at once."""
    evaluate_command(["--methods", "dp", "nr", "--scenes", "1", "--first-scene", "20001", "--attempts", "2",
                      "--workers", "1", "--out", str(tmp_path / "out")])  # fmt: skip
    attempts = {r["arm"]: r["attempts"] for r in read_results(tmp_path / "out" / "episodes.jsonl")}
    assert attempts == {"dp": 1, "nr": 2}


def test_results_of_another_plan_are_refused(tmp_path):
    evaluate(tmp_path, PLAN, 1, lambda record: None, begin, work)
    with pytest.raises(ConfigError, match="another plan"):
        evaluate(tmp_path, dataclasses.replace(PLAN, max_attempts=5), 1, lambda record: None, begin, work)
    assert json.loads((tmp_path / "plan.json").read_text())["max_attempts"] == 2


def test_a_plan_may_grow_by_an_arm_but_not_change_one(tmp_path):
    evaluate(tmp_path, dataclasses.replace(PLAN, arms=PLAN.arms[:1]), 1, lambda record: None, begin, work)
    WORKED.clear()
    evaluate(tmp_path, PLAN, 1, lambda record: None, begin, work)
    assert [a["name"] for a in json.loads((tmp_path / "plan.json").read_text())["arms"]] == ["nr", "far"]
    changed = Arm(name="far", method="far", retry=RetryConfig(fcpa=FCPAConfig(lr=1e-3)))
    with pytest.raises(ConfigError, match="another plan"):
        evaluate(tmp_path, dataclasses.replace(PLAN, arms=(PLAN.arms[0], changed)), 1, print, begin, work)


def test_a_first_attempt_success_is_run_once():
    calls = []

    def run(take):
        while (episode := take()) is not None:
            calls.append(episode)
            scene = episode[1]
            outcome = Outcome(success=scene == 5, judged_by=Judge.TWIN)
            attempt = Attempt(index=1, scene_seed=scene, steps=(), final=None, outcome=outcome, policy_version="base")
            yield episode, Trial(scene_seed=scene, attempts=(attempt,), adaptations=())

    known = [(4, {"nr": {"scene": 4, "success": True, "attempts": 1}}), (7, {"nr": {"success": False, "attempts": 1}})]
    records = list(run_scenes([(5, {}), (6, {}), *known], ["nr", "far"], run))
    assert calls == [("nr", 5), ("nr", 6), ("far", 6), ("far", 7)]
    assert sorted((r["arm"], r["scene"], r.get("shared", False)) for r in records) == [
        ("far", 4, True), ("far", 5, True), ("far", 6, False), ("far", 7, False), ("nr", 5, False), ("nr", 6, False)
    ]  # fmt: skip


def written(folder, text):
    path = folder / "arms.toml"
    path.write_text(text)
    return path


def test_arms_from_a_file_differ_only_where_it_says(tmp_path):
    plain, small = read_arms_file(written(tmp_path, """
[[arm]]
name = "nr"
method = "nr"
[[arm]]
name = "far, smaller steps"
method = "far"
retry.fcpa = { lr = 2e-6, guard = "scale" }
retry.perturbation.dims = [0, 1, 2]
"""))  # fmt: skip
    assert plain == Arm(name="nr", method="nr")
    assert small.retry.fcpa == FCPAConfig(lr=2e-6, guard="scale")
    assert small.retry.perturbation.dims == (0, 1, 2)
    assert small.retry.pairs == RetryConfig().pairs


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[[arm]]\nname = 'a'\nmethod = 'nr'\nretry.fcpa.rate = 1", "unknown setting rate; known: .*lr"),
        ("[[arm]]\nname = 'a'\nmethod = 'nr'\nretry.fcpa.lr = -1", "fcpa.lr is -1"),
        ("[[arm]]\nname = 'a'\nmethod = 'nr'\nretry.fcpa = 3", "retry.fcpa is 3, must be a table"),
        ("[[arm]]\nname = 'a'", "arm 1 has no method"),
        ("[[arm]]\nname = 'a'\nmethod = 'nr'\n" * 2, "an arm twice"),
        ("arm = 1", r"must list \[\[arm\]\]"),
        ("[[arm", "not valid TOML"),
    ],
)
def test_a_wrong_file_of_arms_is_named(tmp_path, text, says):
    with pytest.raises(ConfigError, match=says):
        read_arms_file(written(tmp_path, text))


def test_results_go_on_wherever_the_checkpoints_lie_but_not_with_others(tmp_path):
    for folder, weights in (("here", b"1"), ("there", b"1"), ("other", b"2")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "policy.safetensors").write_bytes(weights)
    here, there, other = (
        dataclasses.replace(PLAN, policy=str(tmp_path / f / "policy.safetensors")) for f in ("here", "there", "other")
    )
    assert here.fingerprint() == there.fingerprint() != other.fingerprint()
    assert str(tmp_path) not in json.dumps(here.fingerprint())


def test_a_setting_added_later_does_not_estrange_old_results():
    """Only what differs from the paper's is written down, NaN not differing from itself."""
    assert differences(RetryConfig(), RetryConfig()) == {}
    assert differences(RetryConfig(fcpa=FCPAConfig(lr=2e-6)), RetryConfig()) == {"fcpa": {"lr": 2e-6}}
