"""What `far import` made of interop/lerobot_writer.py's dataset: python interop/imported.py DEMOS.hdf5"""

from __future__ import annotations

import sys

import h5py
import numpy as np


def main(demos: str) -> None:
    with h5py.File(demos) as file:
        assert len(file["data"]) == 2
        for episode in range(2):
            demo, t = file[f"data/demo_{episode}"], np.arange(20)
            np.testing.assert_array_equal(
                demo["actions"][:], np.repeat((t / 20).astype(np.float32)[:, None], 7, axis=1)
            )
            np.testing.assert_array_equal(demo["obs/robot0_eef_pos"][:, 0], t)
            shade = 10 * t + 5 * episode
            np.testing.assert_array_equal(demo["obs/wrist_image"][:, 0, 0, 0], shade)
            error = np.abs(demo["obs/front_image"][:].mean((1, 2, 3)) - shade)
            assert error.max() < 3, f"a frame of the video is another one: {error}"
    print("far import reads what lerobot wrote: pictures exactly, video frame by frame")


if __name__ == "__main__":
    main(*sys.argv[1:])
