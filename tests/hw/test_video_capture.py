"""The V4L2 capture against a device of our own behind OpenCV's interface, and a real video file."""

from __future__ import annotations

import os
import time

import cv2
import numpy as np
import pytest

from far_app.errors import ConfigError, RobotError
from hw.camera_config import CameraConfig
from hw.video_capture import DeviceCapture, FileCapture, on_monotonic_clock

ZED = CameraConfig(device="/dev/video0", width=2560, height=720, eye="left")


class Device:
    """cv2.VideoCapture of a camera that has some sizes only and stamps on some clock."""

    def __init__(self, sizes=((2560, 720),), rates=(60.0,), offset: float = 0.0) -> None:
        self.sizes, self.rates, self.offset = sizes, rates, offset
        self.asked: dict[int, float] = {}
        self.there, self.gives, self.released, self.stamp = True, True, False, 0.0

    def isOpened(self):
        return self.there

    def set(self, what, value):
        self.asked[what] = value
        return True

    def size(self):
        wanted = self.asked.get(cv2.CAP_PROP_FRAME_WIDTH), self.asked.get(cv2.CAP_PROP_FRAME_HEIGHT)
        return wanted if wanted in self.sizes else self.sizes[0]

    def get(self, what):
        if what == cv2.CAP_PROP_POS_MSEC:
            return 1000.0 * self.stamp
        if what == cv2.CAP_PROP_FPS:
            wanted = self.asked.get(cv2.CAP_PROP_FPS)
            return wanted if wanted in self.rates else self.rates[0]
        return float(self.size()[0] if what == cv2.CAP_PROP_FRAME_WIDTH else self.size()[1])

    def read(self):
        self.stamp = time.monotonic() - 0.02 + self.offset
        width, height = self.size()
        return (True, np.zeros((height, width, 3), np.uint8)) if self.gives else (False, None)

    def release(self):
        self.released = True


def capture(device: Device, config: CameraConfig = ZED) -> DeviceCapture:
    made = DeviceCapture("front", config)
    made._opened = lambda _: device  # type: ignore[assignment, method-assign, return-value]
    return made


def test_a_device_is_told_size_rate_format_and_to_give_colours_and_its_stamps_are_kept():
    device = Device()
    camera = capture(device)
    camera.open()
    assert device.asked == {
        cv2.CAP_PROP_FOURCC: cv2.VideoWriter.fourcc(*"YUYV"), cv2.CAP_PROP_FRAME_WIDTH: 2560,
        cv2.CAP_PROP_FRAME_HEIGHT: 720, cv2.CAP_PROP_FPS: 60.0, cv2.CAP_PROP_CONVERT_RGB: 1,
    }  # fmt: skip
    shot = camera.grab()
    assert shot.image.shape == (720, 2560, 3) and shot.stamp == pytest.approx(device.stamp)
    camera.close()
    assert device.released


def test_another_size_than_asked_for_is_an_error_with_both():
    device = Device(sizes=((1280, 480),))
    with pytest.raises(ConfigError, match="gives 1280×480, the rig asks for 2560×720"):
        capture(device).open()
    assert device.released


def test_another_rate_than_asked_for_is_an_error_with_both():
    with pytest.raises(ConfigError, match="gives 15 frames a second at 2560×720, the rig asks for 60"):
        capture(Device(rates=(15.0,))).open()


def test_frames_of_another_size_than_the_driver_says_are_an_error_too():
    device = Device()
    device.read = lambda: (True, np.zeros((480, 640, 3), np.uint8))  # type: ignore[method-assign]
    with pytest.raises(ConfigError, match="a frame of 640×480"):
        capture(device).open()


@pytest.mark.parametrize("offset", [1.7e9, -50.0, 5.0])
def test_stamps_of_another_clock_are_replaced_by_arrival_and_said(offset, caplog):
    camera = capture(Device(offset=offset))
    camera.open()
    assert "not on the monotonic clock" in caplog.text
    assert camera.grab().stamp == pytest.approx(time.monotonic(), abs=0.05)


def test_a_device_that_is_not_there_or_falls_silent_is_an_error_that_says_what_to_look_at():
    device = Device()
    device.there = False
    with pytest.raises(RobotError, match="plugged in"):
        capture(device).open()
    device.there = True
    camera = capture(device)
    camera.open()
    device.gives = False
    with pytest.raises(RobotError, match="unplugged"):
        camera.grab()


def test_a_device_that_does_not_exist_is_refused_by_opencv_itself():
    with pytest.raises(RobotError, match="/dev/video-none cannot be opened"):
        DeviceCapture("front", CameraConfig(device="/dev/video-none")).open()


def test_a_silent_device_is_given_up_after_a_second():
    assert os.environ["OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT"] == "1"


def test_the_monotonic_clock_is_recognised():
    assert on_monotonic_clock(99.96, 100.0) and not on_monotonic_clock(100.1, 100.0)
    assert not on_monotonic_clock(0.0, 100.0)


def test_a_file_plays_at_its_rate_over_and_over(tmp_path):
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (64, 48))
    for level in (40, 120, 200):
        writer.write(np.full((48, 64, 3), level, np.uint8))
    writer.release()
    config = CameraConfig(device=f"file:{path}", width=64, height=48, rate=100.0)
    camera = FileCapture("front", config)
    camera.open()
    began = time.monotonic()
    levels = [round(float(camera.grab().image.mean()), -1) for _ in range(7)]
    assert levels == [40, 120, 200, 40, 120, 200, 40]
    assert time.monotonic() - began > 0.065
    camera.close()
    with pytest.raises(ConfigError, match="640×480"):
        wrong = FileCapture("front", CameraConfig(device=f"file:{path}"))
        wrong.open()
        wrong.grab()
