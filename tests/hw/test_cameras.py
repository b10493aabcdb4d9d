"""Hardware cameras without hardware: what is noticed of bad frames, and what becomes of a camera that is lost."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from far_app.errors import ConfigError, RobotError
from far_app.picture import seen
from far_app.protocols import Camera
from far_app.tasks import supervised
from hw.camera_config import CameraConfig, views_of, with_views
from hw.camera_reader import CameraReader, digest
from hw.capture import Shot, capture_for
from hw.hardware_view import HardwareView
from hw.rig import RIGS, load_rig
from hw.synthetic_camera import SyntheticCapture, number_in, numbered
from tests.hw.test_threads import TASK, BlindView

CONFIG = CameraConfig(device="synthetic", width=256, height=72, eye="left", rate=100.0, lost_after=0.3)


@pytest.fixture
def capture() -> SyntheticCapture:
    return SyntheticCapture(CONFIG)


@pytest.fixture
def reader(capture: SyntheticCapture) -> Iterator[CameraReader]:
    reader = CameraReader("front", capture, CONFIG)
    reader.start()
    yield reader
    reader.close()


def eventually(what: Callable[[], object], limit: float = 5.0) -> None:
    deadline = time.monotonic() + limit
    while not what():
        assert time.monotonic() < deadline, "it never came to that"
        time.sleep(0.005)


class Frames:
    """Frames fed by hand to a reader whose thread does not run."""

    def __init__(self) -> None:
        self.reader = CameraReader("front", SyntheticCapture(CONFIG), CONFIG)
        self.reader.newest = Shot(image=numbered(0, 72, 256), stamp=10.0)
        self.reader._digest = 0

    def take(self, number: int, stamp: float, late: float = 0.0) -> None:
        self.reader._take(Shot(image=numbered(number, 72, 256), stamp=stamp), stamp + late)


# ── the numbered picture ──


@pytest.mark.parametrize("number", [0, 1, 4711, 65535])
@pytest.mark.parametrize("eye", ["left", "right"])
def test_a_number_survives_cropping_and_shrinking(number, eye):
    half = numbered(number, 720, 1280)
    frame = np.concatenate([half, half], axis=1)
    for size in (84, 224):
        assert number_in(seen(frame, replace(CONFIG, eye=eye).views("a")["a"], size)) == number


# ── what is noticed ──


def test_a_gap_between_timestamps_is_frames_dropped():
    frames = Frames()
    frames.take(1, 10.01)
    frames.take(2, 10.0245)
    assert frames.reader.counts.dropped == 0, "1.45 periods are jitter"
    frames.take(5, 10.0545)
    assert (frames.reader.counts.frames, frames.reader.counts.dropped) == (3, 2)


def test_a_frame_that_arrives_late_is_stale_and_still_the_newest():
    frames = Frames()
    frames.take(1, 10.01, late=0.14)
    assert frames.reader.counts.stale == 0
    frames.take(2, 10.02, late=0.16)
    assert frames.reader.counts.stale == 1 and frames.reader.newest.stamp == 10.02


def test_a_repeated_timestamp_or_a_repeated_picture_is_frozen_and_no_news():
    frames = Frames()
    frames.take(1, 10.01)
    frames.take(2, 10.01)
    assert frames.reader.counts.frozen == 1, "a timestamp again"
    frames.take(1, 10.02)
    assert frames.reader.counts.frozen == 2, "a picture again"
    assert frames.reader.newest.stamp == 10.01
    assert "same picture" in frames.reader.trouble(10.32) and not frames.reader.trouble(10.30)
    frames.take(3, 10.5)
    assert frames.reader.counts.dropped == 0, "what was frozen was not dropped"
    assert not frames.reader.trouble(10.6)


def test_the_newest_frame_is_at_most_a_period_old(reader: CameraReader, capture: SyntheticCapture):
    ages = []
    for _ in range(30):
        time.sleep(0.011)
        ages.append(time.monotonic() - reader.newest.stamp)
    assert np.median(ages) < 2.5 / CONFIG.rate


def test_dropped_frames_are_counted_from_a_running_camera(reader: CameraReader, capture: SyntheticCapture):
    eventually(lambda: reader.counts.frames > 5)
    before = reader.counts.dropped
    capture.skip = 4
    eventually(lambda: reader.counts.dropped >= before + 3)


@pytest.mark.parametrize("kind", ["frozen", "stuck"])
def test_a_frozen_camera_is_lost_after_its_limit_and_well_again_after(kind, reader, capture):
    eventually(lambda: reader.counts.frames > 3)
    setattr(capture, kind, True)
    eventually(lambda: reader.trouble(time.monotonic()))
    assert "camera front is lost: it shows the same picture" in reader.trouble(time.monotonic())
    assert reader.counts.frozen > 5
    setattr(capture, kind, False)
    eventually(lambda: not reader.trouble(time.monotonic()))


def test_an_unplugged_camera_is_lost_opened_again_and_goes_on(reader: CameraReader, capture: SyntheticCapture):
    eventually(lambda: reader.counts.frames > 3)
    seen_before, dropped = reader.counts.frames, reader.counts.dropped
    capture.unplugged = True
    eventually(lambda: reader.trouble(time.monotonic()))
    assert "unplugged" in reader.trouble(time.monotonic()) and "press Resume" in reader.trouble(time.monotonic())
    capture.unplugged = False
    eventually(lambda: not reader.trouble(time.monotonic()))
    assert reader.counts.reopened == 1 and capture.opened == 2
    eventually(lambda: reader.counts.frames > seen_before + 3)
    assert reader.counts.dropped <= dropped + 2, "the outage is not counted as dropped frames"


def test_a_camera_that_breaks_in_its_own_way_is_opened_again(reader: CameraReader, capture: SyntheticCapture):
    def broken() -> Shot:
        del capture.grab  # type: ignore[method-assign]
        raise OSError("bulk transfer failed")

    capture.grab = broken  # type: ignore[method-assign]
    eventually(lambda: reader.counts.reopened == 1)


def test_a_camera_that_is_not_there_or_gives_another_size_ends_the_start():
    capture = SyntheticCapture(CONFIG)
    capture.unplugged = True
    with pytest.raises(RobotError, match="plug it in"):
        HardwareView(BlindView(good=9), {"front": CONFIG}, lambda name, config: capture)
    capture.unplugged, capture.gives = False, (480, 1280)
    with pytest.raises(ConfigError, match="gives 1280×480, the rig asks for 256×72"):
        HardwareView(BlindView(good=9), {"front": CONFIG}, lambda name, config: capture)


# ── views ──


def test_trouble_can_be_planned_by_the_devices_name():
    now = [0.0]
    config = replace(CONFIG, device="synthetic:unplugged@5+3,frozen@9+1,slow@20+1")
    capture = SyntheticCapture(config, clock=lambda: now[0])
    assert type(capture_for("a", config)) is SyntheticCapture
    expected = {0.0: (), 5.0: ("unplugged",), 7.9: ("unplugged",), 8.1: (), 9.5: ("frozen",), 10.0: (), 20.5: ("slow",)}
    for now[0], troubles in expected.items():
        capture._act_out()
        assert capture.unplugged == ("unplugged" in troubles) and capture.frozen == ("frozen" in troubles)
        assert (capture.delay > 0) == ("slow" in troubles)
    with pytest.raises(ConfigError, match="'burning@1' must be KIND@START"):
        SyntheticCapture(replace(CONFIG, device="synthetic:burning@1"))


def test_both_eyes_are_two_views_of_one_device():
    cameras = {"zed": replace(CONFIG, eye="both"), "wrist": CameraConfig(device="synthetic", rate=100.0)}
    assert list(views_of(cameras)) == ["zed_left", "zed_right", "wrist"]
    assert with_views(TASK, cameras).cameras == ("zed_left", "zed_right", "wrist")
    assert with_views(TASK, None) is TASK and with_views(TASK, {}).cameras == ()
    view = HardwareView(BlindView(good=9), cameras)
    assert len(view.readers) == 2
    frames = [view.camera(name, 84).frame() for name in views_of(cameras)]
    assert all(frame.image.shape == (84, 84, 3) for frame in frames)
    assert frames[0].stamp == pytest.approx(frames[1].stamp, abs=0.1)
    with pytest.raises(ConfigError, match="'front'; it has zed_left, zed_right, wrist"):
        view.camera("front", 84)
    view.close()


def test_a_hardware_camera_keeps_the_promise_of_every_camera():
    view = HardwareView(BlindView(good=9), {"front": CONFIG})
    camera = view.camera("front", 36)
    assert isinstance(camera, Camera) and (camera.name, camera.height, camera.width) == ("front", 36, 36)
    first = camera.frame()
    assert first.image.shape == (36, 36, 3) and first.image.dtype == np.uint8 and first.image.flags.c_contiguous
    eventually(lambda: camera.frame().seq > first.seq)
    assert camera.frame().stamp > first.stamp and number_in(camera.frame().image) > number_in(first.image)
    view.close()


def test_colours_arrive_as_rgb():
    class Blue(SyntheticCapture):
        def _picture(self):
            picture = super()._picture()
            picture[:, :, 0] = 200
            return picture

    view = HardwareView(BlindView(good=9), {"front": CONFIG}, lambda name, config: Blue(config))
    assert (view.camera("front", 36).frame().image[:, :, 2] == 200).all(), "OpenCV's first channel is our last"
    view.close()


# ── settings ──


@pytest.mark.parametrize(("settings", "word"), [
    ({"width": 0}, "width is 0"), ({"format": "RGB"}, "format is 'RGB'"), ({"eye": "third"}, "eye is 'third'"),
    ({"crop": (0, 0, 2000, 100)}, "does not fit"), ({"rotate": 30}, "rotate is 30"),
])  # fmt: skip
def test_settings_that_cannot_be_are_refused(settings, word):
    with pytest.raises(ConfigError, match=word):
        CameraConfig(device="synthetic", **settings)


def test_a_device_name_chooses_the_capture():
    assert type(capture_for("a", CONFIG)).__name__ == "SyntheticCapture"
    assert type(capture_for("a", replace(CONFIG, device="file:clip.avi"))).__name__ == "FileCapture"
    assert type(capture_for("a", replace(CONFIG, device="/dev/video0"))).__name__ == "DeviceCapture"


def test_a_rig_file_names_its_cameras_says_that_it_has_none_or_leaves_them_to_the_task(tmp_path):
    twin = (RIGS / "twin.toml").read_text()
    path = tmp_path / "rig.toml"
    for head, tail, expected in (("", "", None), ("cameras = []\n", "", {}), ("", '[camera.a]\ndevice = "x"', ["a"])):
        path.write_text(f"{head}{twin}\n{tail}\n")
        cameras = load_rig(str(path)).cameras
        assert cameras == expected or (cameras is not None and list(cameras) == expected)
    path.write_text(twin + '\n[camera.a]\ndevice = "x"\nlens = 3\n')
    with pytest.raises(ConfigError, match="a: unknown setting lens"):
        load_rig(str(path))


def test_the_papers_rig_is_one_view_of_a_zed_minis_left_eye():
    rig = load_rig("paper")
    assert rig.cameras is not None and list(views_of(rig.cameras)) == ["front"]
    camera = rig.cameras["front"]
    assert (camera.width, camera.height, camera.rate, camera.eye) == (2560, 720, 60.0, "left")
    entry = supervised(with_views(TASK, rig.cameras))
    assert (entry.cameras, entry.max_attempts, entry.judge) == (("front",), 3, "person")


def test_a_synthetic_camera_is_in_the_trouble_that_its_file_names(tmp_path):
    file = tmp_path / "trouble"
    capture = SyntheticCapture(CameraConfig(device=f"synthetic:{file}", width=64, height=48, rate=500.0))
    capture.open()
    assert capture.grab().stamp < capture.grab().stamp, "no file, no trouble"
    file.write_text("frozen")
    assert digest(capture.grab()) == digest(capture.grab())
    file.write_text("unplugged\n")
    with pytest.raises(RobotError, match="unplugged"):
        capture.grab()
    file.write_text("")
    capture.open()
    capture.grab()
