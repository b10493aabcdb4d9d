"""A made day of telemetry for benchmarks: python -m far_app.bench.replayed_day FOLDER --hours H --speed X.

Plays the app and the hw server towards a page: trials of three attempts with values, flags, adaptations, events and a
history that grows, pictures that move. Time runs `speed` times faster than the clock; what is published is the state
at that time, RATE times a second, as latest-wins publishers do. Ends by itself.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import zmq

from far_app.endpoints import Endpoints
from far_app.session_states import Intent, State
from far_app.telemetry import LogLine, LoopHealth, Telemetry, TrialRow, View
from far_app.types import AdaptationStep, Pose, RobotMode, RobotStatus
from far_app.wire import pack

RATE = 30.0
"""Messages a second of the clock, telemetry and view each; the page looks ten times a second."""
ATTEMPT, LEARN, HORIZON, H = 5.0, 4.0, 150, 8
"""Seconds of an attempt and of what follows a failed one; ticks."""
TRIAL = 3 * (ATTEMPT + LEARN)
"""Every trial fails twice and succeeds at the third attempt."""


def telemetry_at(t: float, seq: int) -> Telemetry:
    """The day's state at second `t`."""
    trial, within = divmod(t, TRIAL)
    attempt, second = divmod(within, ATTEMPT + LEARN)
    running = second < ATTEMPT
    tick = min(HORIZON, int(second * HORIZON / ATTEMPT))
    ticks = np.arange(tick + 1)
    values = 0.4 + 0.3 * np.tanh((ticks - 40) / 25) + 0.05 * np.sin(ticks / 7 + trial + attempt)
    changes = values[H:] - values[:-H] if not running else np.zeros(0)
    threshold = float(np.percentile(changes, 10)) if len(changes) else math.nan
    steps = 0 if running else min(10, int(10 * (second - ATTEMPT) / LEARN) + 1)
    return Telemetry(
        seq=seq, stamp=time.monotonic(), state=State.RUNNING if running else State.ADAPTING, session="replayed",
        task="lift", method="far", policy_version=f"base+{int(attempt)}", trial=int(trial) + 1, trials=0,
        attempt=int(attempt) + 1, max_attempts=3, scene_seed=1000 + int(trial), tick=tick, horizon=HORIZON,
        values=values, value_changes=changes, threshold=threshold,
        flagged=tuple(int(i) for i in np.flatnonzero(changes <= threshold)),
        adaptation=tuple(
            AdaptationStep(step=k, steps=10, loss=0.69 - 0.01 * k, winner_error=0.4 - 0.003 * k, loser_error=0.4)
            for k in range(1, steps + 1)
        ),
        adaptation_status="" if running else "update", pairs=0 if running else 120,
        eef=Pose(position=np.array([0.4, 0.1 * math.sin(t), 0.2]), quaternion=np.array([0.0, 0, 0, 1])),
        joints=np.sin(t + np.arange(7)), action=np.sin(3 * t + np.arange(7)),
        chunk_path=np.linspace([0.4, 0.1 * math.sin(t), 0.2], [0.45, 0.1, 0.1], H),
        loop=LoopHealth(hz=30.0, ticks=int(30 * t), late_p50_ms=0.4, late_p99_ms=1.7, late_max_ms=4.2),
        history=_history(int(trial)), log=_log(int(trial), int(attempt)),
        allowed=(Intent.STOP, Intent.PAUSE, Intent.MARK_SUCCESS, Intent.SKIP_TRIAL, Intent.QUIT),
    )  # fmt: skip


def _history(trials: int) -> tuple[TrialRow, ...]:
    return tuple(
        TrialRow(trial=k, scene_seed=999 + k, attempts=3, success=True, judged_by="twin", flagged=30, seconds=TRIAL,
                 note=f"note {k}")
        for k in range(max(1, trials - 199), trials + 1)
    )  # fmt: skip


def _log(trial: int, attempt: int) -> tuple[LogLine, ...]:
    now = time.monotonic()
    return tuple(
        LogLine(stamp=now - 9.0 * k, level="info", text=f"trial {trial + 1}, event {3 * trial + attempt - k}")
        for k in range(49, -1, -1)
    )


def _view(t: float, seq: int) -> View:
    image = np.full((320, 320, 3), 60, np.uint8)
    x = int(150 + 120 * math.sin(t))
    image[100:200, x : x + 40] = (200, 60, 60)
    encoded = cv2.imencode(".jpg", image)[1].tobytes()
    jpegs = {name: encoded for name in ("front", "wrist")}
    poses = np.tile(np.array([0.3, 0.1 * math.sin(t), 0.2, 0, 0, 0, 1.0]), (14, 1))
    status = RobotStatus(mode=RobotMode.TRACKING)
    return View(seq=seq, stamp=time.monotonic(), jpegs=jpegs, body_poses=poses, status=status)


def publish(folder: Path, seconds: float, speed: float) -> None:
    """For `seconds` of the day."""
    context: zmq.Context[Any] = zmq.Context()
    at = Endpoints.in_folder(folder)
    sockets = []
    for endpoint in (at.telemetry, at.view):
        socket = context.socket(zmq.PUB)
        socket.setsockopt(zmq.LINGER, 0)
        socket.bind(endpoint)
        sockets.append(socket)
    began, seq = time.monotonic(), 0
    try:
        while (t := speed * (time.monotonic() - began)) < seconds:
            seq += 1
            sockets[0].send(pack(telemetry_at(t, seq)))
            sockets[1].send(pack(_view(t, seq)))
            time.sleep(1 / RATE)
    finally:
        context.destroy(linger=0)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m far_app.bench.replayed_day", description="A day of telemetry.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--hours", type=float, default=10.0)
    parser.add_argument("--speed", type=float, default=20.0)
    options = parser.parse_args(arguments)
    publish(options.folder, 3600 * options.hours, options.speed)
    return 0


if __name__ == "__main__":
    sys.exit(main())
