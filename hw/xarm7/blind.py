"""A view of an arm without cameras or a model to draw: for rigs that say `cameras = []`."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from far_app.errors import RobotError
from far_app.telemetry import SceneGeometry


class BlindView:
    """hw.plant.PlantView of nothing."""

    def image(self, snapshot: Any, camera: str, size: int) -> UInt8[np.ndarray, "size size 3"]:
        raise RobotError(f"this rig has no camera '{camera}': its file says cameras = []")

    def body_poses(self, snapshot: Any) -> Float[np.ndarray, "B 7"]:
        return np.empty((0, 7))

    def geometry(self) -> SceneGeometry:
        return SceneGeometry(meshes=(), body_names=())

    def close(self) -> None: ...
