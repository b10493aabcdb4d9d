"""The session in rerun while it runs: python -m ui.rerun_live --run-folder DIR [--recordings DIR].

Its own process, at low priority: the page and the app run without it. Subscribes to telemetry for V, ΔV, flags, actions
and events as they happen, and adds each attempt's cameras when its recording is closed. A server on loopback keeps the
newest 64 MB; the web viewer is served on loopback too. Says {"viewer": URL} on standard output when ready.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import shutil
import signal
import socket
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import zmq

from far_app.endpoints import Endpoints
from far_app.errors import FarError
from far_app.parent import die_with_parent
from far_app.recording.attempt_reader import read_attempt
from far_app.recording.replay import LOOPBACK
from far_app.recording.scan import ends_in_order
from far_app.signal_event import SignalSafeEvent
from far_app.telemetry import Telemetry
from ui.access import Access
from ui.feeds import Latest
from ui.rerun_views import (
    ACTIONS,
    APPLICATION,
    TIMELINE,
    Curves,
    blueprint,
    log_attribution,
    log_cameras,
    log_event,
    log_styles,
    log_values,
)
from ui.rerun_web import SealedViewer, take_viewer

log = logging.getLogger(__name__)

MEMORY = "64MB"
LOOK = 1 / 15
FILES_EVERY = 1.0
"""Seconds between looks for newly closed attempts."""


class LiveLog:
    """Telemetry, snapshot by snapshot, as entities of one recording. One thread only: rerun's time is per thread."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self.origin: float | None = None
        """Monotonic seconds at 0 of the timeline."""
        self._attempt: tuple[int, int] = (-1, -1)
        self._began = 0.0
        self._known = np.zeros(0, dtype=bool)
        self._attributed = False
        self._event = 0.0
        log_styles(recording)

    def show(self, t: Telemetry) -> None:
        if self.origin is None:
            self.origin, self._event = t.stamp, t.stamp - 3600
        now = t.stamp - self.origin
        if (t.trial, t.attempt) != self._attempt:
            self._attempt, self._attributed = (t.trial, t.attempt), False
            self._began, self._known = now - t.tick / t.rate, np.zeros(0, dtype=bool)
            self._break_lines(self._began - 1e-3)
        times = self._began + np.arange(len(t.values)) / t.rate
        self._values(t, times)
        if len(t.value_changes) and not self._attributed:
            self._attributed = True
            curves = Curves(
                times=times, values=t.values, changes=t.value_changes, threshold=t.threshold, flagged=t.flagged,
                chunk_horizon=t.chunk_horizon,
            )  # fmt: skip
            log_attribution(self._recording, curves, ("front", "wrist"))
        self._motion(t, now)
        for line in t.log:
            if line.stamp > self._event:
                log_event(self._recording, line.stamp - self.origin, line.text, line.level.upper()[:4])
                self._event = line.stamp

    def _break_lines(self, time: float) -> None:
        """No line from one attempt to the next."""
        self._recording.set_time(TIMELINE, duration=time)
        for path in ("/value/V", "/change/dV", "/change/threshold", *(f"/action/{name}" for name in ACTIONS)):
            self._recording.log(path, rr.Scalars(float("nan")))

    def _values(self, t: Telemetry, times: np.ndarray) -> None:
        """V of the ticks that were not known before; some come a tick or two late."""
        known = np.isfinite(t.values)
        before = np.zeros(len(known), dtype=bool)
        before[: len(self._known)] = self._known[: len(known)]
        fresh = known & ~before
        self._known = known
        log_values(self._recording, times[fresh], t.values[fresh])

    def _motion(self, t: Telemetry, now: float) -> None:
        self._recording.set_time(TIMELINE, duration=now)
        if t.state == "running" and len(t.action):
            for name, value in zip(ACTIONS, t.action, strict=False):
                self._recording.log(f"/action/{name}", rr.Scalars(float(value)))
        for j, angle in enumerate(t.joints):
            self._recording.log(f"/joints/{j + 1}", rr.Scalars(float(angle)))


class ClosedAttempts:
    """Finds each attempt's file once its writer has closed it."""

    def __init__(self, recordings: Path) -> None:
        self._recordings = recordings
        self._seen: set[Path] = set()
        self._session: Path | None = None

    def newly_closed(self, session: str) -> list[Path]:
        folder = self._recordings / session
        if not session or not folder.is_dir():
            return []
        files = sorted(folder.glob("trial_*/attempt_*.mcap"))
        if folder != self._session:
            self._session = folder
            self._seen = set(files[:-1])  # a viewer that comes late begins with the newest
        closed = [file for file in files if file not in self._seen and ends_in_order(file)]
        self._seen.update(closed)
        return closed


def serve(options: argparse.Namespace, ended: SignalSafeEvent) -> None:
    orphaned = die_with_parent()
    data, program = free_port(), free_port()
    recording = rr.RecordingStream(APPLICATION, recording_id=f"live-{os.getpid()}")
    sink = rr.GrpcServerSink(bind_ip=LOOPBACK, port=data, server_memory_limit=MEMORY)
    recording.set_sinks(sink, default_blueprint=blueprint(live=True))
    recording.send_recording_name("live")
    folder = options.run_folder / "rerun_web"
    folder.mkdir(exist_ok=True)
    take_viewer(folder, program, free_port())
    viewer = SealedViewer(folder, Access.at(options.host, options.token), options.web_port, data)
    live, files = LiveLog(recording), ClosedAttempts(options.recordings)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    feed = Latest(context, Endpoints.in_folder(options.run_folder).telemetry, Telemetry)
    sys.stdout.write(json.dumps({"viewer": viewer.url}) + "\n")
    sys.stdout.flush()
    next_look = 0.0
    try:
        while not ended.wait(LOOK) and not orphaned():
            if feed.poll():
                live.show(feed.message)
            if feed.message and time.monotonic() > next_look:
                next_look = time.monotonic() + FILES_EVERY
                add_cameras(recording, live, files.newly_closed(feed.message.session))
    finally:
        viewer.close()
        shutil.rmtree(folder, ignore_errors=True)
        feed.close()
        context.destroy(linger=0)


def add_cameras(recording: rr.RecordingStream, live: LiveLog, closed: Sequence[Path]) -> None:
    for file in closed:
        try:
            log_cameras(recording, read_attempt(file).steps, live.origin or 0.0)
        except (FarError, OSError) as error:
            log.warning("%s is not shown: %s", file, error)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def main(arguments: Sequence[str] | None = None) -> int:
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(levelname)s %(message)s")
    parser = argparse.ArgumentParser(prog="python -m ui.rerun_live", description="The session in rerun, live.")
    parser.add_argument("--run-folder", type=Path, required=True, help="folder with the run's sockets")
    parser.add_argument("--recordings", type=Path, default=Path("recordings"), help="folder of the sessions")
    parser.add_argument("--host", default=LOOPBACK, help="address of the web viewer; any but loopback needs --token")
    parser.add_argument("--token", type=Path, default=None, help="file of the token, made where it is missing")
    parser.add_argument("--web-port", type=int, default=0, help="port of the web viewer; 0 takes a free one")
    options = parser.parse_args(arguments)
    os.nice(5)
    ended = SignalSafeEvent().set_on(signal.SIGTERM, signal.SIGINT)
    try:
        serve(options, ended)
    except FarError as error:
        log.error("%s", error)
        return 2
    return 0


if __name__ == "__main__":
    code = main()
    logging.shutdown()
    os._exit(code)  # rerun may wait at exit for a viewer that never came
