"""Captures through OpenCV: a V4L2 device, and a video file that stands in for one.

Traps: select() waits 10 s for a silent device unless told otherwise before the first capture; V4L2 takes the nearest
size it has and says nothing, so width and height are both set and read back; a camera's own default may be any size;
frame rates are promised, never kept to the digit.
"""

from __future__ import annotations

import logging
import os
import time

os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "1")  # seconds; read once, at the first capture

import cv2
import numpy as np

from far_app.errors import ConfigError, RobotError
from hw.camera_config import CameraConfig
from hw.capture import FILE, Shot

log = logging.getLogger(__name__)

OLDEST = 1.0
"""Seconds before its arrival that a frame's timestamp may lie; else it is of another clock."""


class DeviceCapture:
    """A Capture of a V4L2 device."""

    def __init__(self, name: str, config: CameraConfig) -> None:
        self._name, self._config = name, config
        self._video: cv2.VideoCapture | None = None
        self._kernel_clock = True

    def open(self) -> None:
        config = self._config
        device = int(config.device) if config.device.isdigit() else os.path.realpath(config.device)
        self._video = video = self._opened(device)
        if not video.isOpened():
            self.close()
            raise RobotError(
                f"camera {self._name}: {config.device} cannot be opened; is it plugged in, used by another program, or "
                "not yours to read (group video)?"
            )
        video.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*config.format))
        video.set(cv2.CAP_PROP_FRAME_WIDTH, config.width)
        video.set(cv2.CAP_PROP_FRAME_HEIGHT, config.height)
        video.set(cv2.CAP_PROP_FPS, config.rate)
        video.set(cv2.CAP_PROP_CONVERT_RGB, 1)  # raw frames of other sizes were broken in OpenCV 4.11
        try:
            self._check(video)
            first = self._read(video)
        except Exception:
            self.close()
            raise
        self._kernel_clock = on_monotonic_clock(stamp_of(video), time.monotonic())
        if not self._kernel_clock:
            log.warning(
                "camera %s: its timestamps (%.3f s) are not on the monotonic clock (%.3f s); arrival times are used",
                self._name, stamp_of(video), time.monotonic(),
            )  # fmt: skip
        log.info("camera %s: %s, %d×%d", self._name, config.device, first.shape[1], first.shape[0])

    def grab(self) -> Shot:
        video = self._video
        if video is None:
            raise RobotError(f"camera {self._name} is not open")
        image = self._read(video)
        arrived = time.monotonic()
        return Shot(image=image, stamp=stamp_of(video) if self._kernel_clock else arrived)

    def close(self) -> None:
        if self._video is not None:
            self._video.release()
            self._video = None

    def _opened(self, device: int | str) -> cv2.VideoCapture:
        """Apart, so that a test can put a device of its own here."""
        return cv2.VideoCapture(device, cv2.CAP_V4L2)

    def _check(self, video: cv2.VideoCapture) -> None:
        """What was asked for against what the driver says it will give."""
        config = self._config
        size = round(video.get(cv2.CAP_PROP_FRAME_WIDTH)), round(video.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if size != (config.width, config.height):
            raise ConfigError(
                f"camera {self._name}: {config.device} gives {size[0]}×{size[1]}, the rig asks for {config.width}×"
                f"{config.height}; list what it can do with `v4l2-ctl --list-formats-ext -d {config.device}` and set "
                "width and height"
            )
        rate = video.get(cv2.CAP_PROP_FPS)
        if rate > 0 and abs(rate - config.rate) > 0.1 * config.rate:
            raise ConfigError(
                f"camera {self._name}: {config.device} gives {rate:g} frames a second at {size[0]}×{size[1]}, the rig "
                f"asks for {config.rate:g}; set rate, or a smaller size, or format MJPG"
            )

    def _read(self, video: cv2.VideoCapture) -> np.ndarray:
        config = self._config
        good, image = video.read()
        if not good:
            raise RobotError(f"camera {self._name}: {config.device} gave no frame; it may be unplugged")
        if image.shape != (config.height, config.width, 3):
            raise ConfigError(
                f"camera {self._name}: {config.device} gave a frame of {image.shape[1]}×{image.shape[0]}, the rig asks "
                f"for {config.width}×{config.height}"
            )
        return image


def stamp_of(video: cv2.VideoCapture) -> float:
    """The V4L2 buffer's timestamp of the frame just read, seconds."""
    return video.get(cv2.CAP_PROP_POS_MSEC) / 1000.0


def on_monotonic_clock(stamp: float, now: float) -> bool:
    """Whether a frame's timestamp can be of our own monotonic clock: a little in the past of its arrival."""
    return 0.0 <= now - stamp < OLDEST


class FileCapture:
    """A Capture of a video file, at the camera's rate, over and over; stamped at arrival."""

    def __init__(self, name: str, config: CameraConfig) -> None:
        self._name, self._config = name, config
        self._path = config.device.removeprefix(FILE)
        self._video: cv2.VideoCapture | None = None
        self._due = 0.0

    def open(self) -> None:
        self._video = cv2.VideoCapture(self._path)
        if not self._video.isOpened():
            self.close()
            raise RobotError(f"camera {self._name}: no video can be read from {self._path}")
        self._due = time.monotonic()

    def grab(self) -> Shot:
        if self._video is None:
            raise RobotError(f"camera {self._name} is not open")
        self._due = max(self._due + 1.0 / self._config.rate, time.monotonic())
        time.sleep(max(0.0, self._due - time.monotonic()))
        good, image = self._video.read()
        if not good:
            self._video.set(cv2.CAP_PROP_POS_FRAMES, 0)
            good, image = self._video.read()
        if not good or image.shape != (self._config.height, self._config.width, 3):
            raise ConfigError(
                f"camera {self._name}: {self._path} holds no frames of {self._config.width}×{self._config.height}"
            )
        return Shot(image=image, stamp=time.monotonic())

    def close(self) -> None:
        if self._video is not None:
            self._video.release()
            self._video = None
