"""Where a device is, and its open descriptor. Linux; reading needs the right to (a udev rule, see docs/step_in.md)."""

from __future__ import annotations

import fcntl
import os
import struct
from pathlib import Path

from far_app.errors import RobotError
from hw.input_device.decoder import Decoder
from hw.input_device.gamepad import STICKS, Gamepad
from hw.input_device.settings import InputDeviceSettings
from hw.input_device.spacemouse import VENDORS, SpaceMouse

HIDRAW, BY_ID = Path("/sys/class/hidraw"), Path("/dev/input/by-id")
NAMES = ("SPACEMOUSE", "SPACENAVIGATOR", "SPACE NAVIGATOR", "SPACEPILOT", "SPACEEXPLORER", "3DCONNEXION")
_EVIOCGABS, _ABSINFO = 0x80184540, struct.Struct("6i")


def open_device(settings: InputDeviceSettings) -> tuple[int, Decoder]:
    """A descriptor that never blocks, and who understands it. Raises RobotError saying what is missing."""
    path = settings.path or (_spacemouse() if settings.kind == "spacemouse" else _gamepad())
    if not path:
        raise RobotError(f"no {settings.kind} is plugged in at this machine; plug it in, or name it: input_device.path")
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    except OSError as error:
        rights = "; give yourself the right to read it (docs/step_in.md)" if isinstance(error, PermissionError) else ""
        raise RobotError(f"{path} cannot be opened: {error.strerror}{rights}") from error
    return descriptor, SpaceMouse() if settings.kind == "spacemouse" else Gamepad(ranges(descriptor))


def ranges(descriptor: int) -> dict[int, tuple[int, int]]:
    """Least and greatest value of each stick that the kernel tells of; nothing for what is no evdev device."""
    found = {}
    for code in STICKS:
        try:
            _, low, high, *_ = _ABSINFO.unpack(fcntl.ioctl(descriptor, _EVIOCGABS + code, bytes(_ABSINFO.size)))
        except OSError:
            continue
        if high > low:
            found[code] = (low, high)
    return found


def _spacemouse() -> str:
    for entry in sorted(HIDRAW.glob("hidraw*")):
        told = dict(line.split("=", 1) for line in _lines(entry / "device/uevent") if "=" in line)
        vendor, name = told.get("HID_ID", "").split(":")[1:2], told.get("HID_NAME", "").upper()
        if vendor and vendor[0].upper() in VENDORS and any(word in name for word in NAMES):
            return f"/dev/{entry.name}"
    return ""


def _gamepad() -> str:
    return next((str(path) for path in sorted(BY_ID.glob("*-event-joystick"))), "")


def _lines(file: Path) -> list[str]:
    try:
        return file.read_text().splitlines()
    except OSError:
        return []
