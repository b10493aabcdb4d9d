"""robomimic's own loader reads our export: python interop/robomimic_loader.py EXPORT.hdf5 DEMOS.hdf5

DEMOS.hdf5 is the same export, imported again by `far import`; both must hold the same, number for number.
"""

from __future__ import annotations

import sys

import h5py
import numpy as np
from stand_in import torchvision_or_stand_in

torchvision_or_stand_in()

import robomimic  # noqa: E402
from robomimic.utils import obs_utils  # noqa: E402
from robomimic.utils.dataset import SequenceDataset  # noqa: E402

LOW = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper", "object")
PICTURES = ("front_image", "wrist_image")


def main(export: str, demos: str) -> None:
    obs_utils.initialize_obs_utils_with_obs_specs({"obs": {"low_dim": list(LOW), "rgb": list(PICTURES)}})

    def dataset(mask: str | None) -> SequenceDataset:
        return SequenceDataset(
            hdf5_path=export, obs_keys=(*LOW, *PICTURES), dataset_keys=("actions", "rewards", "dones"), seq_length=2,
            frame_stack=2, load_next_obs=True, filter_by_attribute=mask, hdf5_cache_mode=None,
        )  # fmt: skip

    whole, at = dataset(None), 0
    with h5py.File(demos) as file:
        for number in range(len(file["data"])):
            demo = file[f"data/demo_{number}"]
            count = len(demo["actions"]) - 1
            for t in range(count):
                item = whole[at + t]
                np.testing.assert_array_equal(item["actions"][1], demo["actions"][t])
                assert item["rewards"][1] == demo["rewards"][t + 1] and item["dones"][1] == demo["dones"][t + 1]
                for key in (*LOW, *PICTURES):
                    np.testing.assert_array_equal(item["obs"][key][1], demo[f"obs/{key}"][t])
                    np.testing.assert_array_equal(item["next_obs"][key][1], demo[f"obs/{key}"][t + 1])
            at += count
        assert at == len(whole)
        solved = [n for n, demo in file["data"].items() if demo.attrs["success"]]
    assert dataset("successes").demos == sorted(solved, key=lambda name: int(name.removeprefix("demo_")))
    print(f"robomimic {robomimic.__version__} reads {len(whole)} ticks of {len(whole.demos)} demos")


if __name__ == "__main__":
    main(*sys.argv[1:])
