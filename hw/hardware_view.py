"""What a rig's own cameras see, in the place of drawn pictures; the arm itself is still drawn by the plant's view.

Frames carry their own timestamps: a Frame of hardware is as old as its picture, not as the servo tick that asked.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from far_app.errors import ConfigError, FarError
from far_app.picture import Framing, seen
from far_app.protocols import Frame
from far_app.telemetry import CameraHealth, SceneGeometry
from hw.camera_config import CameraConfig
from hw.camera_reader import CameraReader
from hw.capture import Capture, Shot, capture_for
from hw.plant import PlantView

log = logging.getLogger(__name__)


class HardwareCamera:
    """far_app.protocols.Camera over one view of a reader's frames, at one size."""

    def __init__(self, name: str, size: int, reader: CameraReader, framing: Framing, *, quick: bool = False) -> None:
        """`quick`: its pictures are for people (far_app/picture.py)."""
        self.name, self.height, self.width = name, size, size
        self._reader, self._framing, self._quick = reader, framing, quick
        self._shot: Shot | None = None
        self._frame: Frame

    def frame(self) -> Frame:
        """The newest; framed once."""
        shot = self._reader.newest
        if shot is not self._shot:
            seq = self._frame.seq + 1 if self._shot is not None else 0
            bgr = seen(shot.image, self._framing, self.height, quick=self._quick)
            self._frame = Frame(image=cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), stamp=shot.stamp, seq=seq)
            self._shot = shot
        return self._frame

    def close(self) -> None:
        """The reader is the view's."""


class HardwareView:
    """A PlantView whose pictures come from cameras; bodies and geometry from another view of the plant."""

    def __init__(
        self,
        bodies: PlantView,
        cameras: Mapping[str, CameraConfig],
        capture: Callable[[str, CameraConfig], Capture] = capture_for,
    ) -> None:
        """Returns with a first frame of every camera. Raises RobotError or ConfigError where one gives none."""
        self._bodies = bodies
        self.readers = {name: CameraReader(name, capture(name, config), config) for name, config in cameras.items()}
        self._views = {
            view: (self.readers[name], framing)
            for name, config in cameras.items()
            for view, framing in config.views(name).items()
        }
        self._cameras: dict[tuple[str, int, bool], HardwareCamera] = {}
        try:
            for reader in self.readers.values():
                reader.start()
        except FarError:
            self.close()
            raise

    def camera(self, name: str, size: int, *, quick: bool = False) -> HardwareCamera:
        """A view of these cameras at a size; a quick one for people."""
        if name not in self._views:
            raise ConfigError(f"the rig has no camera view '{name}'; it has {', '.join(self._views)}")
        if (name, size, quick) not in self._cameras:
            self._cameras[name, size, quick] = HardwareCamera(name, size, *self._views[name], quick=quick)
        return self._cameras[name, size, quick]

    def health(self, now: float) -> dict[str, CameraHealth]:
        """Of every view: its camera's."""
        return {view: reader.health(now) for view, (reader, _) in self._views.items()}

    def trouble(self, now: float) -> str:
        """Why a camera counts as lost; empty while all are well."""
        return next((words for reader in self.readers.values() if (words := reader.trouble(now))), "")

    def image(self, snapshot: Any, camera: str, size: int) -> UInt8[np.ndarray, "size size 3"]:
        """The newest frame, whatever the snapshot."""
        return self.camera(camera, size).frame().image

    def body_poses(self, snapshot: Any) -> Float[np.ndarray, "B 7"]:
        return self._bodies.body_poses(snapshot)

    def geometry(self) -> SceneGeometry:
        return self._bodies.geometry()

    def close(self) -> None:
        for name, reader in self.readers.items():
            reader.close()
            log.info(
                "camera %s: %d frames, %d dropped, %d stale, %d frozen, reopened %d times", name, reader.counts.frames,
                reader.counts.dropped, reader.counts.stale, reader.counts.frozen, reader.counts.reopened,
            )  # fmt: skip
        self._bodies.close()
