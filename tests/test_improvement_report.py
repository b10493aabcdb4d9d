"""Runs of improvement side by side: what is pooled, what is paired, and what may not be mixed."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

from far_app.cli import main
from far_app.errors import ConfigError
from far_app.improvement import Epoch
from far_app.improvement_report import curves, improvements_in, markdown

SCENES = range(30_000, 30_010)


def run(
    folder: Path, collector: str, seed: int, solved: dict[int, int], ticks: int = 100, reward: str = "shaped"
) -> Path:
    """A finished run of `far improve`: how many of SCENES (the first ones) its policy solves after which epoch."""
    folder.mkdir(parents=True)
    plan = {"task": "lift", "collector": collector, "loop": {"reward": reward, "seed": seed}}
    (folder / "plan.json").write_text(json.dumps(plan))
    lines = []
    for epoch in range(max(solved) + 1):
        count = solved.get(epoch)
        evaluation = None if count is None else {"scenes": len(SCENES), "solved": count}
        found = Epoch(epoch=epoch, episodes=20 * epoch, timesteps=ticks * epoch, evaluation=evaluation)
        lines.append(json.dumps(dataclasses.asdict(found)))
        if count is not None:
            results = folder / f"epoch-{epoch:02d}" / "evaluation" / "episodes.jsonl"
            results.parent.mkdir(parents=True)
            records = [{"arm": "dp", "scene": s, "success": i < count, "attempts": 1} for i, s in enumerate(SCENES)]
            results.write_text("".join(json.dumps(r) + "\n" for r in records))
    (folder / "log.jsonl").write_text("\n".join(lines) + "\n")
    return folder


def test_collectors_are_compared_scene_by_scene_and_their_seeds_pooled(tmp_path):
    for seed in (0, 1):
        run(tmp_path / f"far-{seed}", "far", seed, {0: 4, 5: 9 - seed}, ticks=200)
        run(tmp_path / f"nr-{seed}", "nr", seed, {0: 4, 5: 6})
    text = markdown(curves([tmp_path]))
    assert "2 runs a collector" in text
    assert "| far | 5 | 100 | 1000 | 85.0 [64.0, 94.8] | +45.0 [" in text, "17 of 20, 8 before"
    assert "far − nr after 5 epochs: +25.0 [" in text and "p = 0.0625" in text, "5 scenes that far alone solves"
    assert text.index("| nr | 0") < text.index("| far | 0")


def test_only_epochs_that_every_run_has_are_told(tmp_path):
    run(tmp_path / "far-0", "far", 0, {0: 4, 5: 6, 10: 9})
    run(tmp_path / "far-1", "far", 1, {0: 4, 5: 6})
    (curve,) = curves([tmp_path])
    assert curve.epochs == [0, 5]


def test_another_reward_is_a_curve_of_its_own(tmp_path):
    run(tmp_path / "a", "far", 0, {0: 4, 5: 6})
    run(tmp_path / "b", "far", 0, {0: 4, 5: 8}, reward="sparse")
    assert [c.name for c in curves([tmp_path])] == ["far", "far, sparse reward"]


def test_nothing_evaluated_yet_is_said(tmp_path):
    folder = run(tmp_path / "far-0", "far", 0, {0: 4})
    (folder / "log.jsonl").write_text("")
    with pytest.raises(ConfigError, match="has no evaluation yet"):
        curves([folder])


def test_far_report_writes_them_and_mixes_no_kinds(tmp_path, capsys):
    one = run(tmp_path / "runs" / "far-0", "far", 0, {0: 4, 5: 6})
    run(tmp_path / "runs" / "dp-0", "dp", 0, {0: 4, 5: 5})
    assert improvements_in(one) == [one] and len(improvements_in(tmp_path / "runs")) == 2
    assert main(["report", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]) == 0
    assert "| dp | 5 |" in (tmp_path / "out" / "README.md").read_text()
    assert (tmp_path / "out" / "improvement.png").stat().st_size > 10_000
    results = Path(__file__).parents[1] / "docs" / "results" / "lift"
    assert main(["report", str(one), str(results), "--out", str(tmp_path / "mixed")]) == 2
    assert "report on each kind by itself" in capsys.readouterr().err
