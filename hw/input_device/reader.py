"""The thread that reads an input device and says what it asks for; looks for it again when it is gone.

Moves nothing: what it says travels with the observations, the app makes targets of it, and they come back through the
safety filter like any other.
"""

from __future__ import annotations

import logging
import os
import select
import threading
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from far_app.device_input import DeviceInput
from far_app.errors import RobotError
from hw.input_device.decoder import Decoder
from hw.input_device.find import open_device
from hw.input_device.settings import InputDeviceSettings

log = logging.getLogger(__name__)

LOOK = 0.02
"""Seconds between looks at whether a deflected device still speaks."""
AGAIN = 1.0
"""Seconds between two looks for a device that is not there."""
GRIP = 0.1
"""Seconds for which a press of a gripper button is told at least: longer than an observation takes."""


class InputReader:
    """Reads until closed; `newest` from any thread."""

    def __init__(
        self,
        settings: InputDeviceSettings,
        find: Callable[[InputDeviceSettings], tuple[int, Decoder]] = open_device,
    ) -> None:
        """`find` opens the device: a descriptor that does not block, and who understands it; or raises RobotError."""
        self._settings, self._find = settings, find
        self._told = DeviceInput(name=settings.kind, motion=np.zeros(6), trouble="it is being looked for")
        self._alive = time.monotonic()
        self._presses = 0
        self._grip, self._grip_until = 0.0, 0.0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="input device", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def newest(self) -> DeviceInput:
        """What the device asks for now, with how long ago it was last known to be there."""
        return replace(self._told, age=max(0.0, time.monotonic() - self._alive))

    def close(self) -> None:
        self._closing.set()
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                descriptor, decoder = self._find(self._settings)
            except RobotError as error:
                self._trouble(str(error))
                self._closing.wait(AGAIN)
                continue
            log.info("%s: it is there", decoder.name)
            try:
                self._read(descriptor, decoder)
            except OSError as error:
                self._trouble(f"it is gone ({error.strerror}); plug it in again")
            finally:
                self._presses += decoder.presses
                os.close(descriptor)

    def _read(self, descriptor: int, decoder: Decoder) -> None:
        """Until it is gone (OSError) or we are closed."""
        heard = time.monotonic()
        poll = select.poll()
        poll.register(descriptor, select.POLLIN)
        self._tell(decoder, heard)
        while not self._closing.is_set():
            ready = poll.poll(int(1000 * LOOK))
            now = time.monotonic()
            if ready:
                raw = os.read(descriptor, decoder.size)
                if not raw:
                    raise OSError(0, "nothing more comes from it")
                decoder.feed(raw)
                heard = now
            silent = now - heard >= decoder.quiet and bool(np.any(self._motion(decoder)))
            self._alive = heard if silent else now
            self._tell(decoder, now)

    def _tell(self, decoder: Decoder, now: float) -> None:
        if decoder.grip:
            self._grip, self._grip_until = decoder.grip, now + GRIP
        self._told = DeviceInput(
            name=decoder.name, motion=self._motion(decoder), gripper=self._grip if now < self._grip_until else 0.0,
            presses=self._presses + decoder.presses,
        )  # fmt: skip

    def _motion(self, decoder: Decoder) -> np.ndarray:
        """Action units, base frame: zero within the dead zone, and no jump at its edge."""
        s = self._settings
        size = np.abs(decoder.axes)
        beyond = np.sign(decoder.axes) * np.maximum(0.0, size - s.deadzone) / (1.0 - s.deadzone)
        way = -1.0 if s.facing else 1.0
        return beyond * np.array(s.signs) * np.array((way, way, 1.0) * 2) * np.repeat((s.speed, s.turn_speed), 3)

    def _trouble(self, why: str) -> None:
        if why != self._told.trouble:
            log.warning("input device: %s", why)
        self._told = replace(self._told, motion=np.zeros(6), gripper=0.0, trouble=why)
