"""Input devices without one: real bytes through the real decoders, descriptors and thread."""

from __future__ import annotations

import os
import socket
import struct
import time

import numpy as np
import pytest

from far_app.errors import ConfigError, RobotError
from far_app.take_over import DEVICE_SILENT
from hw.input_device.find import open_device
from hw.input_device.gamepad import (
    ABS_RX,
    ABS_RY,
    ABS_X,
    ABS_Y,
    EAST,
    EV_ABS,
    EV_KEY,
    EV_SYN,
    EVENT,
    SHOULDER,
    SOUTH,
    START,
    SYN_DROPPED,
    Gamepad,
)
from hw.input_device.reader import InputReader
from hw.input_device.settings import InputDeviceSettings
from hw.input_device.spacemouse import SpaceMouse
from hw.rig import load_rig

FORWARD, LEFT, UP = np.eye(3)


def move(*axes: int, report: int = 1) -> bytes:
    return struct.pack(f"<B{len(axes)}h", report, *axes)


def event(kind: int, code: int, value: int) -> bytes:
    return EVENT.pack(12, 345678, kind, code, value)


def wait(condition, seconds: float = 5.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never came to that"
        time.sleep(0.005)


# ── SpaceMouse ──


@pytest.mark.parametrize(
    ("report", "axes"),
    [
        (move(0, -350, 0), [*FORWARD, 0, 0, 0]),
        (move(-350, 0, 0), [*LEFT, 0, 0, 0]),
        (move(0, 0, -350), [*UP, 0, 0, 0]),
        (move(0, 0, -175, report=2), [0, 0, 0, 0, 0, 0.5]),
        (move(-350, 0, 0, 0, -350, 0), [*LEFT, *FORWARD]),
        (move(0, -2000, 0), [*FORWARD, 0, 0, 0]),
    ],
)
def test_a_cap_that_is_pushed_reads_as_the_person_sees_it(report, axes):
    mouse = SpaceMouse()
    mouse.feed(report)
    assert np.allclose(mouse.axes, axes)


def test_translation_and_rotation_come_in_reports_of_their_own_and_zero_is_let_go():
    mouse = SpaceMouse()
    mouse.feed(move(0, -350, 0))
    mouse.feed(move(0, 0, 350, report=2))
    assert np.allclose(mouse.axes, [*FORWARD, *-UP])
    mouse.feed(move(0, 0, 0))
    mouse.feed(move(0, 0, 0, report=2))
    assert not mouse.axes.any()


def test_buttons_count_once_a_press_and_the_second_closes_then_opens():
    mouse = SpaceMouse()
    for report in (b"\x03\x01\x00", b"\x03\x01\x00", b"\x03\x00\x00", b"\x03\x01\x00"):
        mouse.feed(report)
    assert mouse.presses == 2
    grips = []
    for report in (b"\x03\x02\x00", b"\x03\x00\x00", b"\x03\x02\x00"):
        mouse.feed(report)
        grips.append(mouse.grip)
    assert grips == [1.0, 0.0, -1.0]


@pytest.mark.parametrize("raw", [b"", b"\x01", b"\x17\x64", b"\x01" + bytes(5), bytes(64), b"\xff" * 13])
def test_what_is_no_report_of_ours_changes_nothing(raw):
    mouse = SpaceMouse()
    mouse.feed(move(0, -350, 0))
    mouse.feed(raw)
    assert np.allclose(mouse.axes, [*FORWARD, 0, 0, 0]) and mouse.presses == 0


# ── gamepad ──


def test_a_pad_moves_only_while_its_shoulder_button_is_held():
    pad = Gamepad()
    pad.feed(event(EV_ABS, ABS_Y, -32768) + event(EV_ABS, ABS_RX, 32767))
    assert not pad.axes.any()
    pad.feed(event(EV_KEY, SHOULDER, 1))
    assert np.allclose(pad.axes, [1, 0, 0, 0, 0, -1], atol=1e-4)
    pad.feed(event(EV_KEY, SHOULDER, 0))
    assert not pad.axes.any()


def test_events_cut_anywhere_in_the_stream_are_whole_again():
    stream = event(EV_KEY, SHOULDER, 1) + event(EV_ABS, ABS_X, -32768) + event(EV_ABS, ABS_RY, -32768)
    stream += event(EV_KEY, START, 1) + event(EV_KEY, START, 2) + event(EV_KEY, START, 0) + event(EV_KEY, SOUTH, 1)
    for cut in range(len(stream)):
        pad = Gamepad()
        pad.feed(stream[:cut])
        pad.feed(stream[cut:])
        assert np.allclose(pad.axes, [0, 1, 1, 0, 0, 0], atol=1e-4) and pad.presses == 1 and pad.grip == 1.0


def test_a_pads_own_ranges_are_used_and_lost_events_let_everything_go():
    pad = Gamepad(ranges={ABS_Y: (0, 255)})
    pad.feed(event(EV_KEY, SHOULDER, 1) + event(EV_ABS, ABS_Y, 0) + event(EV_KEY, EAST, 1))
    assert np.allclose(pad.axes[0], 1.0) and pad.grip == -1.0
    pad.feed(event(EV_SYN, SYN_DROPPED, 0))
    assert not pad.axes.any() and pad.grip == 0.0


# ── the thread ──


class Reading:
    """A reader on one end of a connection that keeps each write apart, as hidraw does each report."""

    def __init__(self, decoder, kind="spacemouse", **settings) -> None:
        self.near, self.far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.near.setblocking(False)
        self.decoder, self.opened = decoder, 0
        self.reader = InputReader(InputDeviceSettings(kind=kind, **settings), self.find)
        self.reader.start()
        wait(lambda: not self.told.trouble)

    def find(self, _settings):
        self.opened += 1
        if self.opened > 1:
            raise RobotError("no spacemouse is plugged in")
        return os.dup(self.near.fileno()), self.decoder

    @property
    def told(self):
        return self.reader.newest()

    def close(self) -> None:
        self.reader.close()
        self.near.close()
        self.far.close()


@pytest.fixture
def mouse():
    reading = Reading(SpaceMouse(), speed=0.5, turn_speed=0.2, deadzone=0.1)
    yield reading
    reading.close()


def test_the_reader_scales_and_lets_go_within_the_dead_zone(mouse):
    mouse.far.send(move(0, -350, 0, 0, 0, 35))
    wait(lambda: mouse.told.motion[0] > 0)
    assert np.allclose(mouse.told.motion, [0.5, 0, 0, 0, 0, 0])
    mouse.far.send(move(0, -36, 0))
    wait(lambda: mouse.told.motion[0] < 0.01)
    assert mouse.told.motion[0] >= 0.0, "no jump at the dead zone's edge"


def test_a_deflected_cap_that_says_no_more_is_told_as_silent_and_one_at_rest_is_not(mouse):
    mouse.far.send(move(0, -350, 0))
    wait(lambda: mouse.told.age > DEVICE_SILENT)
    mouse.far.send(move(0, 0, 0))
    wait(lambda: mouse.told.age < 0.1)
    time.sleep(2 * DEVICE_SILENT)
    assert mouse.told.age < 0.1, "a cap at rest has nothing to say"


def test_a_device_that_is_pulled_out_moves_nothing_and_is_looked_for_again(mouse):
    mouse.far.send(b"\x03\x01\x00")
    mouse.far.send(move(0, -350, 0))
    wait(lambda: mouse.told.presses == 1 and mouse.told.motion.any())
    mouse.far.close()
    wait(lambda: mouse.told.trouble != "")
    assert not mouse.told.motion.any() and mouse.told.presses == 1
    wait(lambda: "plugged in" in mouse.told.trouble)


def test_a_short_press_of_the_grip_is_told_long_enough_to_be_seen(mouse):
    mouse.far.send(b"\x03\x02\x00")
    mouse.far.send(b"\x03\x00\x00")
    wait(lambda: mouse.told.gripper == 1.0)
    wait(lambda: mouse.told.gripper == 0.0)


def test_a_named_path_is_opened_and_read(tmp_path):
    path = tmp_path / "event7"
    os.mkfifo(path)
    writer = os.open(path, os.O_RDWR)
    reader = InputReader(InputDeviceSettings(kind="gamepad", path=str(path), facing=True, deadzone=0.0))
    reader.start()
    os.write(writer, event(EV_KEY, SHOULDER, 1) + event(EV_ABS, ABS_Y, -32768))
    wait(lambda: bool(reader.newest().motion.any()))
    assert reader.newest().motion[0] == pytest.approx(-0.4), "from the front, forward is toward the person"
    reader.close()
    os.close(writer)


def test_what_is_missing_is_said():
    with pytest.raises(RobotError, match="cannot be opened"):
        open_device(InputDeviceSettings(kind="gamepad", path="/nowhere/event0"))
    with pytest.raises(ConfigError, match="speed"):
        InputDeviceSettings(kind="gamepad", speed=1.5)
    with pytest.raises(ConfigError, match="kind"):
        InputDeviceSettings(kind="joystick")  # pyright: ignore[reportArgumentType]
    assert load_rig("twin").input_device.kind == "", "no device unless a rig names one"
