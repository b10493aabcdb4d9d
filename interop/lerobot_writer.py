"""A dataset that LeRobot itself writes, for `far import` to read: python interop/lerobot_writer.py FOLDER

Two episodes, one camera as pictures, one as H.264 video; the state named as ours is.
"""

from __future__ import annotations

import sys

import numpy as np
from stand_in import torchvision_or_stand_in

torchvision_or_stand_in()

from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402

STATE = ["x", "y", "z", "qx", "qy", "qz", "qw", "gripper"]


def main(root: str) -> None:
    picture = {"shape": (96, 96, 3), "names": ["height", "width", "channels"]}
    dataset = LeRobotDataset.create("far/interop", 30, root=root, vcodec="h264", features={
        "observation.state": {"dtype": "float32", "shape": (8,), "names": STATE},
        "action": {"dtype": "float32", "shape": (7,), "names": None},
        "observation.images.front": {"dtype": "video", **picture},
        "observation.images.wrist": {"dtype": "image", **picture},
    })  # fmt: skip
    for episode in range(2):
        for t in range(20):
            shade = np.full((96, 96, 3), 10 * t + 5 * episode, np.uint8)
            dataset.add_frame({
                "observation.state": np.full(8, t, np.float32), "action": np.full(7, t / 20, np.float32),
                "observation.images.front": shade, "observation.images.wrist": shade, "task": "lift",
            })  # fmt: skip
        dataset.save_episode()
    dataset.finalize()


if __name__ == "__main__":
    main(*sys.argv[1:])
