"""How a real scene looked when the operator said that it was ready, and how well it matched: pictures beside the
trial's attempts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from far_app.recording.images import encode_png
from far_app.recording.session_folder import trial_folder


@dataclass(frozen=True, kw_only=True)
class SceneAccepted:
    scene: str
    """Its name in the plan."""
    images: Mapping[str, UInt8[np.ndarray, "H W 3"]]
    """Camera to RGB, at the policy's size."""
    scores: Mapping[str, float] = field(default_factory=dict)
    """Camera to match with the reference, 0 to 1; empty where this is the reference."""
    limit: float = 0.0
    """Below it the operator was asked twice."""


def write_scene(folder: Path, trial: int, scene: SceneAccepted) -> dict[str, Any]:
    """The pictures as `trial_N/scene_CAMERA.png`; what the log says of them. Raises OSError."""
    pictures = {camera: f"{trial_folder(trial)}/scene_{camera}.png" for camera in scene.images}
    for camera, name in pictures.items():
        (folder / name).write_bytes(encode_png(np.ascontiguousarray(scene.images[camera])))
    return {"scene": scene.scene, "scores": dict(scene.scores), "limit": scene.limit, "pictures": pictures}
