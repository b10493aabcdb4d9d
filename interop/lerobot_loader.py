"""LeRobot's own loader reads our export: python interop/lerobot_loader.py DATASET DEMOS.hdf5

DEMOS.hdf5 is the same export, imported again by `far import`; both must hold the same, number for number.
"""

from __future__ import annotations

import sys

import h5py
import numpy as np
import torch
from stand_in import torchvision_or_stand_in

torchvision_or_stand_in()

import lerobot  # noqa: E402
from lerobot.datasets.compute_stats import get_feature_stats  # noqa: E402
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402


def main(root: str, demos: str) -> None:
    dataset = LeRobotDataset("far/interop", root=root, delta_timestamps={"action": [0.0, 1 / 30, 2 / 30]})
    at = 0
    with h5py.File(demos) as file:
        for number in range(dataset.meta.total_episodes):
            demo = file[f"data/demo_{number}"]
            count = len(demo["actions"]) - 1  # the last row is the observation after the last action
            pose = [demo[f"obs/{key}"][:count] for key in ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper")]
            states, actions = np.concatenate(pose, axis=1), demo["actions"][:]
            cameras = [key.removesuffix("_image") for key in demo["obs"] if key.endswith("_image")]
            for t in range(count):
                item = dataset[at + t]
                np.testing.assert_array_equal(item["observation.state"], states[t])
                np.testing.assert_array_equal(item["action"][0], actions[t])
                inside = [t + k < count for k in range(3)]
                assert item["action_is_pad"].tolist() == [not x for x in inside]
                assert (int(item["episode_index"]), int(item["frame_index"])) == (number, t)
                assert bool(item["next.success"]) == bool(demo["dones"][t + 1])
                for camera in cameras:
                    pixels = item[f"observation.images.{camera}"].permute(1, 2, 0) * 255
                    np.testing.assert_array_equal(pixels.round().byte().numpy(), demo[f"obs/{camera}_image"][t])
            at += count
        assert at == len(dataset) == dataset.meta.total_frames
    for name in ("observation.state", "action", "next.reward"):
        rows = torch.stack(list(dataset.hf_dataset[name])).numpy().reshape(len(dataset), -1)
        # theirs is worked out in float32 from squares; ours is exact
        theirs = get_feature_stats(rows, axis=0, keepdims=False)
        for key in ("min", "max", "mean", "std"):
            np.testing.assert_allclose(dataset.meta.stats[name][key], theirs[key], rtol=1e-4, atol=1e-4)
    for name in dataset.meta.camera_keys:
        assert dataset.meta.stats[name]["mean"].shape == (3, 1, 1) and (dataset.meta.stats[name]["std"] > 0).all()
    batch = next(iter(torch.utils.data.DataLoader(dataset, batch_size=8, shuffle=True)))
    assert batch["action"].shape == (8, 3, 7) and torch.isfinite(batch["action"]).all()
    print(f"lerobot {lerobot.__version__} reads {len(dataset)} frames of {dataset.meta.total_episodes} episodes, "
          f"{len(batch)} columns each, tasks {list(dataset.meta.tasks.index)}")  # fmt: skip


if __name__ == "__main__":
    main(*sys.argv[1:])
