"""One camera of a rig, as its file tells it: a table [camera.NAME]; NAME is the view that policies ask for.

[camera.front]
device = "/dev/v4l/by-id/usb-STEREOLABS_ZED-M-video-index0"
width = 2560
height = 720
eye = "left"
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from far_app.config import TaskConfig, from_table
from far_app.errors import ConfigError
from far_app.picture import Framing


@dataclass(frozen=True, kw_only=True)
class CameraConfig:
    """A USB camera: what it is asked for, and what part of it a policy sees."""

    device: str
    """Path of a V4L2 device (the names below /dev/v4l/by-id survive a re-plug), "file:PATH" for a video that plays over
    and over, or "synthetic" for a picture that only tells its own number."""
    width: int = 640
    """Pixels of a whole frame: both eyes of a side-by-side stereo camera."""
    height: int = 480
    rate: float = 60.0
    """Frames a second asked for. The newest is sampled at the policy's rate: a ZED Mini at 60 is 30–45 ms late, at 30
    66–100 ms (its maker's figures)."""
    format: str = "YUYV"
    """Four letters of the pixel format: YUYV uncompressed, MJPG for a camera behind USB 2."""
    eye: Literal["", "left", "right", "both"] = ""
    """Of a side-by-side stereo camera; both gives two views, NAME_left and NAME_right."""
    rotate: int = 0
    """Degrees counter-clockwise, in steps of 90."""
    crop: tuple[int, ...] = ()
    """left, top, width, height in pixels of the turned eye; the largest centred square when empty."""
    stale_after: float = 0.15
    """Seconds from capture to arrival above which a frame counts as stale."""
    lost_after: float = 1.0
    """Age of the newest picture, seconds, at which the camera counts as lost: a fault."""

    def __post_init__(self) -> None:
        for name in ("width", "height", "rate", "stale_after", "lost_after"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"camera {name} is {getattr(self, name)}, must be above 0")
        if len(self.format) != 4:
            raise ConfigError(f"camera format is '{self.format}', must be four letters, such as YUYV or MJPG")
        if self.eye not in ("", "left", "right", "both"):
            raise ConfigError(f"camera eye is '{self.eye}', must be left, right, both or empty (one lens)")
        for framing in self.views("").values():
            width = self.width // 2 if framing.eye else self.width
            framing.box(*((width, self.height) if self.rotate % 180 else (self.height, width)))

    def views(self, name: str) -> dict[str, Framing]:
        """What this camera shows, by the view's name."""
        if self.eye == "both":
            return {
                f"{name}_left": Framing(eye="left", rotate=self.rotate, crop=self.crop),
                f"{name}_right": Framing(eye="right", rotate=self.rotate, crop=self.crop),
            }
        return {name: Framing(eye=self.eye, rotate=self.rotate, crop=self.crop)}


def cameras_from(table: dict[str, Any], where: str) -> dict[str, CameraConfig] | None:
    """Takes the cameras out of a rig file: its [camera.NAME] tables, {} for `cameras = []`, None for neither."""
    none_on_purpose = table.get("cameras") == []
    if none_on_purpose:
        del table["cameras"]
    tables = table.pop("camera", {} if none_on_purpose else None)
    if tables is None:
        return None
    if not isinstance(tables, dict) or not all(isinstance(one, dict) for one in tables.values()):
        raise ConfigError(f"{where}.camera must hold a table for each camera, such as [camera.front]")
    return {name: from_table(CameraConfig, one, f"{where}.camera.{name}") for name, one in tables.items()}


def views_of(cameras: Mapping[str, CameraConfig]) -> dict[str, Framing]:
    """Every view of a rig's cameras, by name."""
    return {name: framing for camera, config in cameras.items() for name, framing in config.views(camera).items()}


def with_views(task: TaskConfig, cameras: Mapping[str, CameraConfig] | None) -> TaskConfig:
    """The task as this rig's cameras see it; a rig that names none (the twin) has the task's own views."""
    return task if cameras is None else replace(task, cameras=tuple(views_of(cameras)))
