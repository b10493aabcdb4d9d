"""A study says which commands make its models and which scenes judge them; its report counts what is there."""

import json
from pathlib import Path

import numpy as np
import pytest

from far_app.cli import main
from far_app.errors import ConfigError
from far_app.evaluation import REPORT_SCENES
from far_app.report import Results, markdown, pooled, read_folder, read_folders
from far_app.study import demonstrating, model_folder, read_study, training

TEXT = """
rig = "panda"
preset = "state"
seeds = [0, 2]
scenes = 10
max_attempts = 3
[[task]]
name = "lift"
demonstrations = 20
iterations = 100
[[arm]]
name = "nr"
method = "nr"
[[arm]]
name = "far, small steps"
method = "far"
retry.fcpa = { lr = 2e-6 }
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "study.toml"
    path.write_text(text)
    return path


def test_every_seed_has_its_own_model_and_its_own_scenes(tmp_path):
    study = read_study(written(tmp_path, TEXT))
    (task,) = study.tasks
    plans = [study.plan(tmp_path, task, seed) for _, seed in study.models]
    scenes = [range(p.first_scene, p.first_scene + p.scenes) for p in plans]
    assert [s.start for s in scenes] == [REPORT_SCENES, REPORT_SCENES + 20]
    assert not set(scenes[0]) & set(scenes[1])
    assert len({p.policy for p in plans}) == 2
    assert [a.name for a in plans[0].arms] == ["nr", "far, small steps"]


def test_the_commands_are_the_documented_ones(tmp_path):
    study = read_study(written(tmp_path, TEXT))
    (task,) = study.tasks
    assert demonstrating(study, tmp_path, task)[:3] == ["demo", "--task", "lift"]
    policy, attempts, critic = training(study, tmp_path, task, 2)
    assert policy[:2] == ["train", "policy"] and critic[:2] == ["train", "critic"] and attempts[0] == "demo"
    assert "--no-images" in attempts
    assert str(model_folder(tmp_path, task, 2) / "policy.safetensors") in critic


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("seeds = [0, 2]", ""), "does not say seeds"),
        (('name = "lift"', 'name = "juggle"'), "unknown task 'juggle'; choose one of: bread"),
        (("scenes = 10", "scenes = 10\nspeed = 2"), "unknown setting speed"),
        (("iterations = 100", "iterations = 100\nlr = 1"), "task 1: unknown setting lr"),
        (('method = "nr"', ""), "arm 1 has no method"),
        (("rig =", "rig"), "not valid TOML"),
    ],
)
def test_a_wrong_study_is_named(tmp_path, change, says):
    with pytest.raises(ConfigError, match=says):
        read_study(written(tmp_path, TEXT.replace(*change, 1)))


def episode(arm: str, scene: int, attempts: int, success: bool) -> dict:
    return {"arm": arm, "scene": scene, "attempts": attempts, "success": success, "ticks": [10] * attempts,
            "adaptations": []}  # fmt: skip


def results() -> Results:
    """Two tasks, two seeds, ten scenes each: nr solves half at once, far all at the second attempt."""
    records = {}
    for task in ("lift", "can"):
        for seed in (0, 1):
            easy = [s < 5 for s in range(10)]
            records[task, f"{task}-{seed}"] = [
                *(episode("nr", s, 1 if e else 2, e) for s, e in enumerate(easy)),
                *(episode("far", s, 1 if e else 2, True) for s, e in enumerate(easy)),
            ]
    return Results(arms=("nr", "far"), max_attempts=2, records=records)


def test_the_report_counts_episodes_seeds_and_pairs():
    text = markdown(results())
    assert "20 episodes of 2 training seeds, up to 2 attempts" in text
    assert "| nr | 50.0 [29.9, 70.1] | 50.0 [29.9, 70.1] | 50.0 ± 0.0 |" in text
    row = next(line for line in text.splitlines() if line.startswith("| far | 50.0"))
    assert "100.0 [83.9, 100.0]" in row and "+50.0" in row and "0.00195" in row
    assert pooled(results(), "far", "nr") == "+50.0 [+35.0, +65.0]", "40 scenes, half of them won"
    assert "## over tasks" in text


def test_a_scene_that_an_arm_has_not_run_counts_for_none():
    whole = results()
    torn = dict(whole.records)
    torn["lift", "lift-0"] = [r for r in torn["lift", "lift-0"] if not (r["arm"] == "far" and r["scene"] == 9)]
    part = Results(arms=whole.arms, max_attempts=2, records=torn)
    assert len(part.solved(("lift", "lift-0"), "nr", 2)) == 9
    assert "19 episodes" in markdown(part)


def test_clusters_not_episodes_are_resampled():
    rng = np.random.default_rng(0)
    records = {}
    for seed, gain in enumerate((0.0, 0.5, 1.0)):
        nr = rng.random(200) < 0.2
        far = nr | (rng.random(200) < gain)
        records["lift", f"lift-{seed}"] = [
            *(episode("nr", s, 2, bool(x)) for s, x in enumerate(nr)),
            *(episode("far", s, 2, bool(x)) for s, x in enumerate(far)),
        ]
    text = pooled(Results(arms=("nr", "far"), max_attempts=2, records=records), "far", "nr")
    low, high = (float(x) for x in text.split("[")[1].rstrip("]").split(","))
    assert high - low > 40, "seeds that differ so much leave the difference wide open, however many their episodes"


def test_a_task_of_one_seed_is_no_surer_than_its_scenes_and_more_tasks_are():
    rng = np.random.default_rng(0)

    def one(task: str) -> dict:
        nr, far = rng.random(50) < 0.6, rng.random(50) < 0.7
        episodes = [episode(a, s, 2, bool(x)) for a, arm in (("nr", nr), ("far", far)) for s, x in enumerate(arm)]
        return {(task, f"{task}-0"): episodes}

    def width(records: dict) -> float:
        text = pooled(Results(arms=("nr", "far"), max_attempts=2, records=records), "far", "nr")
        low, high = (float(x) for x in text.split("[")[1].rstrip("]").split(","))
        return high - low

    lone = width(one("lift"))
    assert 20 < lone < 45, "some 2 × 1.96 × √(0.45 / 50), in points"
    assert width({k: v for task in ("lift", "can", "stack", "door") for k, v in one(task).items()}) < 0.7 * lone


def written_results(folder: Path, whole: Results, arms: str = "nr far") -> None:
    """As far eval leaves them."""
    for (task, model), records in whole.records.items():
        (folder / model).mkdir(parents=True)
        plan = {"task": task, "arms": [{"name": a} for a in arms.split()], "max_attempts": whole.max_attempts}
        (folder / model / "plan.json").write_text(json.dumps(plan))
        lines = "".join(json.dumps(r) + "\n" for r in records)
        (folder / model / "episodes.jsonl").write_text(lines)


def test_a_folder_is_reported_as_tables_and_a_picture(tmp_path):
    written_results(tmp_path, results())
    assert read_folder(tmp_path) == results()
    assert main(["report", str(tmp_path)]) == 0
    text = (tmp_path / "README.md").read_text()
    assert markdown(read_folder(tmp_path)) in text and "The paper's, 5 demonstrations, within 5: dp 50.0 ± 14.4" in text
    assert (tmp_path / "success.png").read_bytes().startswith(b"\x89PNG")
    assert main(["report", str(tmp_path / "lift-0"), "--out", str(tmp_path / "one")]) == 0
    assert "10 episodes of 1 training seed," in (tmp_path / "one" / "README.md").read_text()


def test_what_cannot_be_reported_together_is_named(tmp_path):
    with pytest.raises(ConfigError, match="no results in"):
        read_folder(tmp_path)
    written_results(tmp_path, results())
    plan = tmp_path / "lift-1" / "plan.json"
    plan.write_text(plan.read_text().replace("far", "rerank"))
    with pytest.raises(ConfigError, match=r"lift-1 compares other methods or settings than .*can-0"):
        read_folder(tmp_path)


def one_task(task: str, arms: tuple[str, ...] = ("nr", "far")) -> Results:
    records = {c: [r for r in rs if r["arm"] in arms] for c, rs in results().records.items() if c[0] == task}
    return Results(arms=arms, max_attempts=2, records=records)


def test_folders_side_by_side_share_a_table_under_the_arms_that_all_have(tmp_path, capsys):
    lift, can = tmp_path / "lift", tmp_path / "can"
    written_results(lift, one_task("lift"), "nr far rerank")
    written_results(can, one_task("can"), "far nr")
    both = read_folders([lift, can])
    assert (both.arms, both.tasks) == (("nr", "far"), ["lift", "can"])
    assert pooled(both, "far", "nr") == pooled(results(), "far", "nr")
    assert main(["report", str(lift), str(can), "--out", str(tmp_path / "both")]) == 0
    assert "## over tasks" in (tmp_path / "both" / "README.md").read_text()
    assert main(["report", str(lift), str(can)]) == 2
    assert "give --out" in capsys.readouterr().err


def test_folders_that_cannot_stand_side_by_side_are_named(tmp_path):
    lift, other = tmp_path / "lift", tmp_path / "other"
    written_results(lift, one_task("lift"))
    with pytest.raises(ConfigError, match="lift lift-0 again"):
        read_folders([lift, lift])
    written_results(other, one_task("can"), "bgr")
    with pytest.raises(ConfigError, match="no arm of the same name"):
        read_folders([lift, other])
    plan = other / "can-0" / "plan.json"
    for path in other.glob("*/plan.json"):
        path.write_text(plan.read_text().replace("bgr", "nr").replace('"max_attempts": 2', '"max_attempts": 3'))
    with pytest.raises(ConfigError, match=r"different numbers of attempts: .*lift 2, .*other 3"):
        read_folders([lift, other])
