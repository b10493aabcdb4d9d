"""The hand on its RS485 line, in a thread of its own: wishes at most ten times a second, the opening read back.

A call on that line may take tens of milliseconds; the servo loop only leaves a wish here and reads the last answer.
"""

from __future__ import annotations

import logging
import threading
import time
from typing import cast

from xarm.wrapper import XArmAPI

from far_app.scheduling import HARDWARE_PRIORITY, real_time_from_here
from hw.xarm7.sdk import OK, gripper_error_text
from hw.xarm7.settings import GripperSettings
from hw.xarm7.units import gripper_position, opening

log = logging.getLogger(__name__)


class Gripper:
    """Runs until closed. `wish` and `opening` for any thread."""

    def __init__(self, api: XArmAPI, settings: GripperSettings) -> None:
        self._api, self._settings = api, settings
        self._wish: float | None = None
        self._sent: float | None = None
        self._enable = threading.Event()
        self._closing = threading.Event()
        self.opening = 1.0
        """0 closed, 1 open; of the last reading."""
        self.error = ""
        """The gripper's own error, in words."""
        self.requests = 0
        """Positions asked for so far."""
        self._thread = threading.Thread(target=self._run, name="gripper", daemon=True)

    def start(self) -> None:
        """Read the hand once, then follow wishes. The hand does not move by this."""
        if self._settings.kind == "none":
            return
        self._read()
        self._enable.set()
        self._thread.start()

    def enable_again(self) -> None:
        """After an error of the arm, which may have switched the tool's power off."""
        self._sent = None
        self._enable.set()

    def wish(self, command: float) -> None:
        """−1 opens, +1 closes; the newest counts."""
        self._wish = gripper_position(command, self._settings.open, self._settings.closed)

    def forget(self) -> None:
        """The hand stays as it is until the next wish."""
        self._wish = None

    def close(self) -> None:
        self._closing.set()
        if self._thread.ident is not None:
            self._thread.join(timeout=2.0)

    def _run(self) -> None:
        real_time_from_here(HARDWARE_PRIORITY)
        while not self._closing.wait(self._settings.period):
            try:
                self._turn()
            except Exception as error:  # whatever the SDK raises on a link that is gone; the link's owner says so
                log.warning("gripper: %s: %s", type(error).__name__, error)
                self._closing.wait(0.5)

    def _turn(self) -> None:
        """One request on the line."""
        wish = self._wish
        if self._enable.is_set():
            self._enable.clear()
            self._set_up()
        elif wish is not None and self._differs(wish):
            self._sent = wish if self._move(wish) == OK else None
            self.requests += 1
        else:
            self._read()

    def _differs(self, wish: float) -> bool:
        stroke = abs(self._settings.open - self._settings.closed)
        if self._sent is None:
            return True
        ends = (self._settings.open, self._settings.closed)
        return abs(wish - self._sent) > self._settings.hysteresis * stroke or (wish in ends and wish != self._sent)

    def _set_up(self) -> None:
        api = self._api
        codes = [api.set_gripper_enable(True)]
        if self._settings.kind == "g1":
            codes += [api.set_gripper_mode(0), api.set_gripper_speed(self._settings.speed)]
        if any(code != OK for code in codes):
            log.warning("the gripper could not be set up (codes %s)", codes)

    def _move(self, position: float) -> int:
        if self._settings.kind == "g2":
            speed, force = int(self._settings.speed), int(self._settings.force)
            return int(self._api.set_gripper_g2_position(position, speed=speed, force=force, wait=False, no_check=True))
        return int(self._api.set_gripper_position(position, wait=False, no_check=True))

    def _read(self) -> None:
        began = time.monotonic()
        read = self._api.get_gripper_g2_position if self._settings.kind == "g2" else self._api.get_gripper_position
        code, position = cast(tuple[int, float | None], read())
        if code == OK and position is not None:
            self.opening = opening(position, self._settings.open, self._settings.closed)
            self.error = ""
        elif self._api._arm.gripper_error_code:
            self.error = gripper_error_text(self._api._arm.gripper_error_code)
        if time.monotonic() - began > 0.5:
            log.info("the gripper's line took %.1f s", time.monotonic() - began)
