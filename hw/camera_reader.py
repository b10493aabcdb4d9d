"""One thread a camera: reads every frame, keeps the newest, and notices what is wrong with them.

    dropped   a gap of more than 1.5 periods between two timestamps (V4L2 hands out no sequence numbers)
    stale     older on arrival than the camera's limit
    frozen    the timestamp or the content of the frame before: no news, so the newest picture grows old
    lost      the newest picture is older than the limit, whatever the reason: a fault, told by `trouble`

A device that fails is opened again, at growing intervals, until it is back.
"""

from __future__ import annotations

import logging
import threading
import time
import zlib
from dataclasses import replace

from far_app.errors import FarError, RobotError
from far_app.scheduling import PROMPT_NICENESS, nice
from far_app.telemetry import CameraHealth
from hw.camera_config import CameraConfig
from hw.capture import Capture, Shot

log = logging.getLogger(__name__)

GAP = 1.5
"""Periods between two frames above which some are missing."""
ROWS = 48
"""About so many rows of a picture go into its digest: sensor noise makes any part of two frames differ."""
FIRST_WAIT, LONGEST_WAIT = 0.25, 2.0
"""Seconds between attempts to open a camera again; doubled each time."""


class CameraReader:
    """Reads from its start until closed."""

    def __init__(self, name: str, capture: Capture, config: CameraConfig) -> None:
        self.name, self.config = name, config
        self._capture = capture
        self.newest: Shot
        """The newest new picture; there from `start` on."""
        self.counts = CameraHealth()
        """Its `age` is for `health` to tell."""
        self._digest = 0
        self._gap_known = True
        """The frame before came right before: a gap between them is frames dropped."""
        self._why = ""
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"camera-{name}", daemon=True)

    def start(self) -> None:
        """Returns with the first frame. Raises RobotError or ConfigError where the camera gives none."""
        self._capture.open()
        try:
            self.newest = self._capture.grab()
        except FarError:
            self._capture.close()
            raise
        self._digest = digest(self.newest)
        self.counts = CameraHealth(frames=1)
        self._thread.start()

    def health(self, now: float) -> CameraHealth:
        """For the page."""
        return replace(self.counts, age=max(0.0, now - self.newest.stamp))

    def trouble(self, now: float) -> str:
        """Why the camera counts as lost; empty while it is well."""
        age = now - self.newest.stamp
        if age <= self.config.lost_after:
            return ""
        why = self._why or "its newest picture does not change"
        return (
            f"camera {self.name} is lost: {why} (newest picture {age:.1f} s old, limit {self.config.lost_after:g} s); "
            "check its plug and cable; it is opened again by itself: press Resume when its picture is back"
        )

    def close(self) -> None:
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(timeout=3.0)

    def _run(self) -> None:
        nice(PROMPT_NICENESS)
        while not self._closing.is_set():
            try:
                self._take(self._capture.grab(), time.monotonic())
            except FarError as error:
                self._reopen(error)
            except Exception as error:  # OpenCV raises its own kind; a camera that breaks must not end its reader
                self._reopen(RobotError(f"{type(error).__name__}: {error}"))
        self._capture.close()

    def _take(self, shot: Shot, now: float) -> None:
        """One frame, seen at `now`."""
        content, before = digest(shot), self.newest
        if shot.stamp <= before.stamp or content == self._digest:
            self._why = "it shows the same picture again and again"
            self.counts = replace(self.counts, frozen=self.counts.frozen + 1)
            self._gap_known = False
            return
        periods = (shot.stamp - before.stamp) * self.config.rate
        missing = round(periods) - 1 if self._gap_known and periods > GAP else 0
        late = now - shot.stamp > self.config.stale_after
        self.counts = replace(
            self.counts, frames=self.counts.frames + 1, dropped=self.counts.dropped + missing,
            stale=self.counts.stale + late,
        )  # fmt: skip
        self._why = "its frames arrive late" if late else ""
        self._digest, self._gap_known = content, True
        self.newest = shot

    def _reopen(self, error: FarError) -> None:
        """Until the device is back, or the reader closed."""
        log.warning("camera %s: %s; opening it again", self.name, error)
        began, wait = time.monotonic(), FIRST_WAIT
        self._why = str(error)
        self._gap_known = False
        self._capture.close()
        while not self._closing.wait(wait):
            try:
                self._capture.open()
            except FarError as still:
                self._why = str(still)
                wait = min(2 * wait, LONGEST_WAIT)
                continue
            self.counts = replace(self.counts, reopened=self.counts.reopened + 1)
            log.warning("camera %s is back after %.1f s", self.name, time.monotonic() - began)
            return


def digest(shot: Shot) -> int:
    """A number that differs between any two pictures a sensor takes."""
    return zlib.crc32(shot.image[:: max(1, len(shot.image) // ROWS)].tobytes())
