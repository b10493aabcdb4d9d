"""Ours → LeRobot or robomimic → ours loses nothing; statistics are those of the values written."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest

from far_app.cli import main
from far_app.exchange.feature_stats import STATISTICS, array_stats, histogram, image_stats
from far_app.learning.dataset import Episode, read_episodes
from far_app.preflight import setup_from
from far_app.recording.episodes import session_episodes
from far_app.recording.reader import read_session
from far_app.recording.schema import SessionInfo
from far_app.recording.writer import SessionWriter
from far_app.types import Observation
from tests.recording import sessions, values

CAMERAS = ("front", "wrist")


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sessions.small_session(tmp_path_factory.mktemp("recordings"))


@pytest.fixture(scope="module")
def lerobot(session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out") / "dataset"
    assert main(["export", str(session), "--to", "lerobot", "--out", str(out), "--instruction", "lift the cube"]) == 0
    return out


@pytest.fixture(scope="module")
def robomimic(session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out") / "session.hdf5"
    assert main(["export", str(session), "--to", "robomimic", "--out", str(out)]) == 0
    return out


def assert_same(a: Episode, b: Episode) -> None:
    assert set(a.images) == set(b.images) == set(CAMERAS)
    for camera in CAMERAS:
        np.testing.assert_array_equal(a.images[camera], b.images[camera])
    for name in ("states", "actions", "rewards", "successes"):
        x, y = getattr(a, name), getattr(b, name)
        assert x.dtype == y.dtype, name
        np.testing.assert_array_equal(x, y)
    assert a.objects is not None and b.objects is not None
    np.testing.assert_array_equal(a.objects.astype(np.float32), b.objects)
    assert (a.success, a.seed) == (b.success, b.seed)


@pytest.mark.parametrize("kind", ["lerobot", "robomimic"])
def test_a_session_comes_back_whole(kind, session, tmp_path, request, capsys):
    out = tmp_path / "demos.hdf5"
    assert main(["import", str(request.getfixturevalue(kind)), "--out", str(out)]) == 0
    assert "front camera ←" in capsys.readouterr().out
    ours, back = session_episodes(session, "lift"), read_episodes(out, CAMERAS)
    assert [len(e) for e in back] == [13, 13] and [e.success for e in back] == [False, True]
    for a, b in zip(ours, back, strict=True):
        assert_same(a, b)


def test_what_comes_back_can_be_exported_and_imported_again(session, robomimic, tmp_path):
    """Demonstrations as `far demo` writes them are robomimic files too: importing one changes nothing."""
    once, twice = tmp_path / "once.hdf5", tmp_path / "twice.hdf5"
    assert main(["import", str(robomimic), "--out", str(once)]) == 0
    assert main(["import", str(once), "--out", str(twice)]) == 0
    for a, b in zip(read_episodes(once, CAMERAS), read_episodes(twice, CAMERAS), strict=True):
        assert_same(a, b)


def test_lerobot_metadata_says_what_is_there(lerobot):
    info = json.loads((lerobot / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_episodes"], info["total_frames"]) == ("v3.0", 30, 2, 24)
    assert info["features"]["observation.images.front"]["dtype"] == "image"
    assert not any("/" in name for name in info["features"])
    rows = pq.read_table(lerobot / "data/chunk-000/file-000.parquet").to_pydict()
    assert set(rows) == set(info["features"])
    assert rows["index"] == list(range(24)) and rows["frame_index"] == [*range(12), *range(12)]
    assert np.allclose(np.diff(rows["far.time"][:12]), 1 / 30, atol=1e-6) and rows["far.time"][12] == 0.0
    assert [tick for tick in range(12) if rows["far.flagged"][tick]] == [3, 4, 5]
    assert np.isfinite(rows["far.value_change"][:5]).all() and np.isnan(rows["far.value_change"][5:12]).all()
    assert rows["far.success"] == [False] * 12 + [True] * 12 and rows["far.attempt"] == [1] * 12 + [2] * 12
    first, second = pq.read_table(lerobot / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert (first["dataset_from_index"], second["dataset_from_index"], second["dataset_to_index"]) == (0, 12, 24)
    assert second["far/previous"] == first["far/id"] and second["far/judged_by"] == "twin"
    assert (first["tasks"], second["length"]) == (["lift the cube"], 12)


def test_lerobot_statistics_are_those_of_the_values(lerobot, session):
    stats = json.loads((lerobot / "meta/stats.json").read_text())
    rows = pq.read_table(lerobot / "data/chunk-000/file-000.parquet")
    for name in ("observation.state", "action", "far.stamp", "next.reward"):
        values = np.array(rows[name].to_pylist(), np.float64).reshape(24, -1)
        assert set(stats[name]) == set(STATISTICS) and stats[name]["count"] == [24]
        np.testing.assert_allclose(stats[name]["mean"], values.mean(0))
        np.testing.assert_allclose(stats[name]["std"], values.std(0), atol=1e-12)
        np.testing.assert_allclose(stats[name]["q90"], np.quantile(values, 0.9, axis=0))
    frames = [s.observation.images["front"] for a in read_session(session).attempts() for s in a.steps]
    pixels = np.stack(frames) / 255.0
    front = stats["observation.images.front"]
    assert front["count"] == [24] and np.shape(front["mean"]) == (3, 1, 1)
    np.testing.assert_allclose(np.ravel(front["mean"]), pixels.mean((0, 1, 2)))
    np.testing.assert_allclose(np.ravel(front["std"]), pixels.std((0, 1, 2)))
    np.testing.assert_allclose(np.ravel(front["max"]), pixels.max((0, 1, 2)))
    first = pq.read_table(lerobot / "meta/episodes/chunk-000/file-000.parquet").to_pylist()[0]
    np.testing.assert_allclose(np.ravel(first["stats/observation.images.front/mean"]), pixels[:12].mean((0, 1, 2)))


def test_image_quantiles_are_the_pixels_own():
    frames = np.random.default_rng(0).integers(0, 256, (3, 20, 20, 3), dtype=np.uint8)
    stats = image_stats(histogram(frames), 3)
    for channel in range(3):
        exact = np.quantile(frames[..., channel], 0.5, method="inverted_cdf") / 255
        assert stats["q50"][channel, 0, 0] == pytest.approx(exact)


def test_unknown_entries_are_passed_over():
    stats = array_stats(np.array([[1.0, np.nan], [3.0, np.nan]]))
    assert stats["mean"].tolist() == [2.0, 0.0] and stats["count"].tolist() == [2]


def test_robomimic_holds_what_its_loader_asks_for(robomimic):
    with h5py.File(robomimic) as file:
        data = file["data"]
        assert data.attrs["total"] == 24 and {"env_name", "type", "env_kwargs"} <= set(
            json.loads(data.attrs["env_args"])
        )
        demo = data["demo_1"]
        assert demo.attrs["num_samples"] == 12 == len(demo["actions"]) == len(demo["states"]) == len(demo["dones"])
        assert set(demo["obs"]) == set(demo["next_obs"]) >= {"front_image", "robot0_eef_pos", "object"}
        np.testing.assert_array_equal(demo["obs/robot0_eef_pos"][1:], demo["next_obs/robot0_eef_pos"][:-1])
        assert list(file["mask/successes"]) == list(file["mask/recoveries"]) == [b"demo_1"]
        assert list(file["mask/failures"]) == [b"demo_0"]


def bare_session(root: Path) -> Path:
    """As on hardware under a policy without cameras: no pictures, no objects, nobody's own check of the task."""
    writer = SessionWriter(root, SessionInfo(task="lift", method="nr"), space_to_start=0, space_to_go_on=0)
    writer.begin_trial(1, 7)
    writer.begin_attempt(1, "base")
    whole = values.attempt(1, 4, success=True)

    def bare(o: Observation) -> Observation:
        return replace(o, images={}, objects={}, success=None, reward=0.0)

    steps = tuple(replace(s, observation=bare(s.observation), success=None, value=float("nan")) for s in whole.steps)
    writer.end_attempt(replace(whole, steps=steps, final=bare(whole.final)))
    writer.end_trial(success=True, attempts=1)
    writer.close()
    return writer.folder


@pytest.mark.parametrize("to", ["lerobot", "robomimic"])
def test_a_session_without_cameras_or_objects_comes_back_too(to, tmp_path):
    folder, out, back = bare_session(tmp_path / "r"), tmp_path / "out", tmp_path / "demos.hdf5"
    assert main(["export", str(folder), "--to", to, "--out", str(out)]) == 0
    assert main(["import", str(out), "--out", str(back)]) == 0
    [ours], [theirs] = session_episodes(folder, "lift"), read_episodes(back, ())
    assert theirs.images == {} and theirs.objects is None and theirs.success
    for name in ("states", "actions", "rewards", "successes"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    assert theirs.successes.tolist() == [False] * 4 + [True], "the operator's success counts from the last tick"


def test_where_the_episodes_come_from_comes_along(tmp_path):
    """What `far demo` notes of its robot, an export notes too, and an import keeps."""
    sample, notes = Path(__file__).parents[2] / "recordings/sample", []
    for to in ("lerobot", "robomimic"):
        out, back = tmp_path / to, tmp_path / f"{to}.hdf5"
        assert main(["export", str(sample), "--to", to, "--out", str(out)]) == 0
        assert main(["import", str(out), "--out", str(back)]) == 0
        with h5py.File(back) as file:
            notes.append(json.loads(file["data"].attrs["env_args"]))
    assert notes[0] == notes[1]
    assert notes[0]["env_name"] == "Lift" and notes[0]["env_kwargs"]["robots"] == "xarm7"
    assert setup_from(notes[0]["setup"]) is not None
