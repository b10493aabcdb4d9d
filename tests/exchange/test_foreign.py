"""Demonstrations made elsewhere: what is mapped to what, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest

from far_app.cli import main
from far_app.errors import RecordingError
from far_app.exchange.video import VideoFrames
from far_app.learning.dataset import read_episodes
from tests.exchange.test_selection import refused
from tests.recording import sessions


def panda_file(path: Path, ticks: int = 6, following: bool = True, **changes: np.ndarray) -> Path:
    """As robomimic's own datasets are."""
    rng = np.random.default_rng(0)
    obs = {
        "agentview_image": rng.integers(0, 256, (ticks, 84, 84, 3), dtype=np.uint8),
        "robot0_eye_in_hand_image": rng.integers(0, 256, (ticks, 84, 84, 3), dtype=np.uint8),
        "robot0_eef_pos": rng.uniform(-1, 1, (ticks, 3)), "robot0_eef_quat": rng.uniform(-1, 1, (ticks, 4)),
        "robot0_gripper_qpos": np.array([[0.04, -0.04]] * 3 + [[0.01, -0.01]] * 3), "object": np.zeros((ticks, 10)),
        "robot0_joint_pos": np.zeros((ticks, 7)),
    }  # fmt: skip
    arrays = {"actions": rng.uniform(-1, 1, (ticks, 7)), "rewards": np.eye(ticks)[-1], "dones": np.eye(ticks)[-1]}
    for name, array in changes.items():
        (arrays if name in arrays else obs)[name] = array
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "type": 1, "env_kwargs": {"robots": ["Panda"]}})
        demo = data.create_group("demo_0")
        demo.attrs["num_samples"] = ticks
        for name, array in arrays.items():
            demo[name] = array
        for name, array in obs.items():
            demo[f"obs/{name}"] = array
            if following:
                demo[f"next_obs/{name}"] = np.roll(array, -1, axis=0)
    return path


def test_a_third_partys_robomimic_file_is_mapped_and_says_how(tmp_path, capsys):
    source, out = panda_file(tmp_path / "ph.hdf5"), tmp_path / "demos.hdf5"
    assert main(["import", str(source), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    for words in ("front camera ← obs/agentview_image", "wrist camera ← obs/robot0_eye_in_hand_image",
                  "gripper opening ← obs/robot0_gripper_qpos", "not used: object, robot0_joint_pos"):  # fmt: skip
        assert words in said
    [episode] = read_episodes(out, ("front", "wrist"))
    assert len(episode) == 7 and episode.success and episode.objects is None
    np.testing.assert_allclose(episode.states[:6, 7], [1, 1, 1, 0.25, 0.25, 0.25])
    assert episode.successes.tolist() == [False] * 6 + [True], "complete after the last action"
    with h5py.File(source) as file:
        np.testing.assert_array_equal(episode.images["front"][:6], file["data/demo_0/obs/agentview_image"])


def test_without_next_obs_the_rows_are_taken_as_they_are(tmp_path):
    out = tmp_path / "demos.hdf5"
    assert main(["import", str(panda_file(tmp_path / "a.hdf5", following=False)), "--out", str(out)]) == 0
    assert len(read_episodes(out, ("front",))[0]) == 6


def test_cameras_can_be_named_and_scaled(tmp_path):
    out = tmp_path / "demos.hdf5"
    words = ["--cameras", "front", "robot0_eye_in_hand_image", "--image-size", "32"]
    assert main(["import", str(panda_file(tmp_path / "a.hdf5")), "--out", str(out), *words]) == 0
    [episode] = read_episodes(out, ("front",))
    assert episode.images["front"].shape == (7, 32, 32, 3)


UNFIT = {
    "two arms": ({"actions": np.zeros((6, 14))}, ["(14,)", "7 are needed"]),
    "not normalised": ({"actions": np.full((6, 7), 40.0)}, ["reach 40", "[−1, 1]"]),
}


@pytest.mark.parametrize("what", ["two arms", "not normalised"])
def test_what_cannot_be_mapped_is_refused_and_nothing_is_written(what, tmp_path, capsys):
    changes, expected = UNFIT[what]
    source, out = panda_file(tmp_path / "a.hdf5", **changes), tmp_path / "demos.hdf5"
    assert main(["import", str(source), "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert all(e in error for e in expected) and not out.exists()


def test_a_gripper_that_is_not_known_is_asked_for(tmp_path, capsys):
    source = panda_file(tmp_path / "a.hdf5")
    with h5py.File(source, "a") as file:
        file["data"].attrs["env_args"] = json.dumps({"env_name": "Lift", "type": 1, "env_kwargs": {"robots": "Sawyer"}})
    assert main(["import", str(source), "--out", str(tmp_path / "o.hdf5")]) == 2
    assert "--gripper" in capsys.readouterr().err
    words = ["import", str(source), "--out", str(tmp_path / "o.hdf5"), "--gripper", "0.01", "0.06"]
    assert main(words) == 0


def test_files_of_another_kind_are_named(tmp_path, capsys):
    out = ["--out", str(tmp_path / "o.hdf5")]
    torn = tmp_path / "torn.hdf5"
    torn.write_bytes(panda_file(tmp_path / "a.hdf5").read_bytes()[:5000])
    refused(["import", str(torn), *out], capsys, str(torn), "truncated or no robomimic HDF5")
    refused(["import", str(tmp_path / "nowhere"), *out], capsys, "does not exist")
    refused(["import", str(tmp_path), *out], capsys, "no LeRobotDataset v3")


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    session = sessions.small_session(tmp_path / "r", steps=5)
    assert main(["export", str(session), "--to", "lerobot", "--out", str(tmp_path / "d")]) == 0
    return tmp_path / "d"


def change_info(dataset: Path, change) -> None:
    info = json.loads((dataset / "meta/info.json").read_text())
    change(info)
    (dataset / "meta/info.json").write_text(json.dumps(info))


def test_lerobot_of_another_version_or_robot_is_refused_by_name(dataset, tmp_path, capsys):
    words = ["import", str(dataset), "--out", str(tmp_path / "o.hdf5")]
    change_info(dataset, lambda info: info.update(codebase_version="v2.1"))
    refused(words, capsys, "LeRobotDataset v2.1", "convert_dataset_v21_to_v30")
    change_info(dataset, lambda info: info.update(codebase_version="v3.0"))
    change_info(dataset, lambda info: info["features"]["observation.state"].update(names=["shoulder_pan"]))
    refused(words, capsys, "shoulder_pan", "a state of joints cannot be imported")


def test_a_damaged_episode_is_left_out_with_a_word(dataset, tmp_path, capsys):
    file = dataset / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(file)
    lengths = table.schema.get_field_index("length")
    pq.write_table(table.set_column(lengths, "length", [[9, 5]]), file)
    assert main(["import", str(dataset), "--out", str(tmp_path / "o.hdf5")]) == 0
    said = capsys.readouterr().out
    assert "episode 0 is left out: 5 of 9 rows are there" in said and "1 episodes" in said


def test_frames_of_a_video_are_counted_not_sought(tmp_path):
    path = tmp_path / "v.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 30, (64, 64))
    for k in range(30):
        writer.write(np.full((64, 64, 3), 8 * k, np.uint8))
    writer.release()
    video = VideoFrames()
    for first, count in ((0, 10), (12, 8), (5, 2)):
        frames = video.read(path, first, count)
        assert np.abs(frames.mean((1, 2, 3)) - 8.0 * np.arange(first, first + count)).max() < 4
    with pytest.raises(RecordingError, match="31 are needed"):
        video.read(path, 30, 1)
