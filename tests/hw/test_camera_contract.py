"""What every Camera promises, held by the twin's."""

from __future__ import annotations

import numpy as np
import pytest

from far_app.errors import RobotError
from far_app.protocols import Camera
from hw.cameras import Moment, TwinCamera
from hw.twin import TwinPlant
from tests.hw.conftest import TASK, LockstepBench


@pytest.mark.parametrize("name", TASK.cameras)
def test_the_twins_camera_gives_the_newest_frame_and_never_an_old_one(
    name: str, plant: TwinPlant, lockstep: LockstepBench
) -> None:
    lockstep.start(seed=1)
    view = lockstep.robot.view
    assert view is not None
    moments = [Moment(snapshot=plant.snapshot(), stamp=1.0, seq=1)]
    camera = TwinCamera(name, 64, view, lambda: moments[-1])
    assert isinstance(camera, Camera)
    assert (camera.name, camera.height, camera.width) == (name, 64, 64)
    first = camera.frame()
    assert first.image.shape == (64, 64, 3)
    assert first.image.dtype == np.uint8
    assert camera.frame() is first, "nothing new to see"
    lockstep.drive(np.array((1.0, 0, 0, 0, 0, 0, -1.0)), 10)
    moments.append(Moment(snapshot=plant.snapshot(), stamp=2.0, seq=2))
    second = camera.frame()
    assert (second.seq, second.stamp) == (2, 2.0)
    assert np.abs(second.image.astype(int) - first.image.astype(int)).mean() > 0.5, "the arm moved"
    camera.close()
    with pytest.raises(RobotError, match="closed"):
        camera.frame()
