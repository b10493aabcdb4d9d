"""STOP's own connection: a frame on the wire at once, then confirmed.

`halt` writes set_state(4) without any lock and without waiting; a thread of its own then asks again until the
controller says that it has stopped. When this connection is gone the others carry the frame.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence

from xarm.wrapper import XArmAPI

from far_app.scheduling import HARDWARE_PRIORITY, real_time_from_here
from hw.xarm7.sdk import OK, write_state_frame

log = logging.getLogger(__name__)

STOPPED = 4
CONFIRM = 3.0
"""Seconds for which a stop that is not confirmed is repeated."""


class StopLine:
    """Owns one connection; may borrow others."""

    def __init__(self, api: XArmAPI, others: Sequence[XArmAPI]) -> None:
        self.api, self._others = api, others
        self._asked = threading.Event()
        self._closing = False
        self.confirmed = threading.Event()
        """The controller said that it has stopped since the last halt."""
        self._thread = threading.Thread(target=self._confirm, name="stop-confirm", daemon=True)
        self._thread.start()

    def halt(self) -> None:
        """Any thread; returns within a millisecond or so. Never raises."""
        self.confirmed.clear()
        if not write_state_frame(self.api, STOPPED):
            sent = [write_state_frame(other, STOPPED) for other in self._others]
            log.error("the STOP connection is gone; the frame went out on %d other connections", sum(sent))
        self._asked.set()

    def error_code(self) -> int:
        """Ask for the controller's error code, at most call-timeout long; 0 when it has none or does not answer."""
        code, words = self.api.get_err_warn_code()
        return int(words[0]) if code == OK else 0

    def close(self) -> None:
        self._closing = True
        self._asked.set()
        self._thread.join(timeout=2.0)

    def _confirm(self) -> None:
        real_time_from_here(HARDWARE_PRIORITY)
        while not self._closing:
            self._asked.wait()
            self._asked.clear()
            if self._closing:
                return
            began = time.monotonic()
            while time.monotonic() - began < CONFIRM and not self._closing:
                if self.api.set_state(STOPPED) == OK and self.api.state == STOPPED:
                    self.confirmed.set()
                    log.warning("STOP confirmed by the controller after %.0f ms", 1e3 * (time.monotonic() - began))
                    break
                time.sleep(0.02)
            else:
                log.error("STOP was sent but not confirmed within %.0f s: use the emergency stop", CONFIRM)
