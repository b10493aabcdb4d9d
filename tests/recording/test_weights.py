"""Adapted weights lie beside the attempt they were learnt from, exact, with their lineage, and become checkpoints."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

from far_app.cli import main
from far_app.errors import RecordingError
from far_app.learning.policy import load_policy, read_card, save_policy
from far_app.protocols import KeepsWeights
from far_app.recording.inspect import inspect_session
from far_app.recording.reader import read_session
from far_app.recording.schema import SessionInfo
from far_app.recording.weights_file import find_version, kept_weights, read_kept
from far_app.recording.writer import SessionWriter
from tests.learning.small import small_attempt, small_policy
from tests.methods.test_methods import adapt, made

from . import sessions


def learnt(root: Path, trials: int = 1) -> tuple[Path, Path, dict[str, torch.Tensor]]:
    """A session in which `far` learns from two failures of each trial; the base checkpoint; what acted last."""
    checkpoint = root / "policy.safetensors"
    save_policy(small_policy(), checkpoint, {"task": "lift"})
    method = made("far", network=load_policy(checkpoint))
    assert isinstance(method, KeepsWeights) and not isinstance(made("bgr"), KeepsWeights)
    info = SessionInfo(task="lift", method="far", policy=str(checkpoint), cameras=("front", "wrist"))
    writer = SessionWriter(root / "r", info, space_to_start=0, space_to_go_on=0)
    for trial in range(1, trials + 1):
        method.begin(trial)
        assert method.adapted is None
        writer.begin_trial(trial, trial)
        for attempt in (1, 2):
            writer.begin_attempt(attempt, method.policy.version)
            failed = small_attempt(index=attempt, scene_seed=trial)
            writer.end_attempt(failed)
            adaptation = adapt(method, failed)
            assert method.adapted is not None
            writer.add_adaptation(adaptation)
            writer.add_weights(method.adapted, adaptation)
        writer.end_trial(success=False, attempts=2)
    writer.close()
    return writer.folder, checkpoint, dict(method.acting.state_dict())


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, dict[str, torch.Tensor]]:
    return learnt(tmp_path_factory.mktemp("learnt"))


def test_each_version_is_kept_with_its_lineage(session):
    folder, _, _ = session
    kept, problems = kept_weights(read_session(folder))
    assert problems == [] and inspect_session(folder).sound
    assert [(k.version, k.parent, k.trial, k.attempt) for k in kept] == [
        ("base+a1", "base", 1, 1),
        ("base+a2", "base+a1", 1, 2),
    ]
    assert all(k.pairs > 0 and k.status == "adapted" and np.isfinite([*k.winner_error, *k.loser_error]).all()
               for k in kept)  # fmt: skip
    lines = [e for e in read_session(folder).log if e.event == "weights_kept"]
    assert [e.detail["file"] for e in lines] == [f"trial_0001/attempt_{k}.weights.safetensors" for k in (1, 2)]
    assert [e.detail["bytes"] for e in lines] == [k.path.stat().st_size for k in kept]
    assert not list(folder.rglob("*.partial"))


def test_a_promoted_version_is_the_policy_that_acted(session, tmp_path, capsys):
    folder, _, acted = session
    out = tmp_path / "checkpoint.safetensors"
    assert main(["policy", "promote", str(folder), "base+a2", "--out", str(out)]) == 0
    assert f"--policy {out}" in capsys.readouterr().out
    back = load_policy(out, "lift").state_dict()
    assert set(back) == set(acted) and all(torch.equal(back[name], acted[name]) for name in acted)
    card = read_card(out)
    assert (card["version"], card["parent"], card["task"]) == ("base+a2", "base+a1", "lift")
    assert main(["policy", "promote", str(folder), "base+a2", "--out", str(out)]) == 2
    assert "exists" in capsys.readouterr().err


def test_the_list_names_versions_losses_and_cost(session, capsys):
    folder, checkpoint, _ = session
    assert main(["policy", "list", str(folder)]) == 0
    said = capsys.readouterr().out
    for words in ("1:base+a1", "1:base+a2", str(checkpoint), "2 versions", "MB", "failure"):
        assert words in said


def test_the_file_is_plain_safetensors(session):
    path = session[0] / "trial_0001/attempt_1.weights.safetensors"
    with safe_open(path, framework="numpy") as file:
        assert all(file.get_tensor(name).dtype == np.float32 for name in file.keys())  # noqa: SIM118 (not a dict)


def test_another_base_an_unknown_version_and_damage_are_named(session, tmp_path, capsys):
    folder, _, _ = session
    other, out = tmp_path / "other.safetensors", ["--out", str(tmp_path / "x.safetensors")]
    save_policy(small_policy(seed=9), other)
    assert main(["policy", "promote", str(folder), "base+a1", "--base", str(other), *out]) == 2
    assert "fingerprint" in capsys.readouterr().err
    assert main(["policy", "promote", str(folder), "base+a7", *out]) == 2
    assert "1:base+a1, 1:base+a2" in capsys.readouterr().err
    torn = tmp_path / "torn.weights.safetensors"
    torn.write_bytes((folder / "trial_0001/attempt_1.weights.safetensors").read_bytes()[:900])
    with pytest.raises(RecordingError, match="truncated"):
        read_kept(torn)


def test_a_version_that_several_trials_have_needs_its_trial(session):
    kept, _ = kept_weights(read_session(session[0]))
    both = [*kept, *(replace(k, trial=2) for k in kept)]
    assert find_version(both, "2:base+a1", session[0]).trial == 2
    with pytest.raises(RecordingError, match="1:base\\+a1, 2:base\\+a1"):
        find_version(both, "base+a1", session[0])


def test_a_session_without_any_says_so(tmp_path, capsys):
    assert main(["policy", "list", str(sessions.small_session(tmp_path, steps=2))]) == 0
    assert "1 adaptations were made, but their weights were not kept" in capsys.readouterr().out


def test_weights_that_are_gone_are_named(tmp_path, capsys):
    folder, _, _ = learnt(tmp_path)
    (folder / "trial_0001/attempt_1.weights.safetensors").unlink()
    assert main(["policy", "list", str(folder)]) == 0
    assert "attempt_1.weights.safetensors is missing" in capsys.readouterr().out
