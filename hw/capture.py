"""Where frames come from: the protocol behind which a device, a file and a synthetic camera look alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import UInt8

from hw.camera_config import CameraConfig

FILE = "file:"
SYNTHETIC = "synthetic"


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One frame as a camera gave it."""

    image: UInt8[np.ndarray, "H W 3"]
    """Whole and BGR, as OpenCV hands it over; nobody writes into it."""
    stamp: float
    """When it was captured, monotonic seconds: the kernel's word where it has one, else the frame's arrival."""


class Capture(Protocol):
    """A camera's frames, one after the other. Called from one thread."""

    def open(self) -> None:
        """Connect (again). Blocks up to about 2 s. Raises RobotError where the device is not there, ConfigError where
        it gives another size or rate than it was asked for."""
        ...

    def grab(self) -> Shot:
        """The next frame; blocks until it is there, at most about 1 s. Raises RobotError when none came."""
        ...

    def close(self) -> None:
        """Let go of the device; may be opened again."""
        ...


def capture_for(name: str, config: CameraConfig) -> Capture:
    """The capture that a camera's `device` names."""
    if config.device.partition(":")[0] == SYNTHETIC:
        from hw.synthetic_camera import SyntheticCapture

        return SyntheticCapture(config)
    from hw.video_capture import DeviceCapture, FileCapture

    if config.device.startswith(FILE):
        return FileCapture(name, config)
    return DeviceCapture(name, config)
