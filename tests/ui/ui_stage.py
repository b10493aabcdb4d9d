"""A test source: plays the app and the hw server towards the page with real Telemetry, View and STOP messages.

What it sends has the shape of a real run but is made up; run it by hand to look at the page:
python tests/ui/ui_stage.py DIR [--scenes]
"""

from __future__ import annotations

import math
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import zmq

from far_app.endpoints import Endpoints
from far_app.session_states import Intent, State
from far_app.telemetry import (
    BodyMesh,
    CameraHealth,
    GeometryRequest,
    LogLine,
    LoopHealth,
    OperatorIntent,
    PagePresence,
    SceneGeometry,
    StopAck,
    StopRequest,
    Telemetry,
    TrialRow,
    View,
)
from far_app.types import AdaptationStep, Pose, RobotMode, RobotStatus
from far_app.wire import pack, unpack

HORIZON, H = 150, 8


def running(tick: int = 87, attempt: int = 1) -> Telemetry:
    """A first attempt under way."""
    t = np.arange(tick + 1)
    values = 0.35 + 0.35 * np.tanh((t - 40) / 25) + 0.015 * np.sin(t / 2.3)
    return Telemetry(
        seq=0, stamp=0.0, state=State.RUNNING, session="2026-01-01_12-00-00", task="lift", method="far",
        policy_version="quickstart-lift" if attempt == 1 else f"quickstart-lift+{attempt - 1}", trial=4, trials=20,
        attempt=attempt, max_attempts=5, scene_seed=1003, tick=tick, horizon=HORIZON, chunk_horizon=H, values=values,
        eef=Pose(position=np.array([0.4, 0.1 * math.sin(tick / 20), 0.2]), quaternion=np.array([1.0, 0, 0, 0])),
        joints=np.linspace(-1, 1, 7), action=np.full(7, 0.1),
        chunk_path=np.stack([np.linspace(0.4, 0.45, H), np.linspace(0, 0.1, H), np.linspace(0.2, 0.1, H)], axis=1),
        loop=LoopHealth(hz=29.98, ticks=4312, late_p50_ms=0.4, late_p99_ms=1.7, late_max_ms=4.2, late_ticks=0,
                        plan_age_ticks=1.0, stages=stages(4312)),
        history=rows(), log=lines(), allowed=(Intent.STOP, Intent.PAUSE, Intent.MARK_SUCCESS, Intent.MARK_FAILURE,
                                              Intent.SKIP_TRIAL, Intent.QUIT),
    )  # fmt: skip


def stages(seed: int) -> np.ndarray:
    """Ten seconds of ticks with a hiccup."""
    rng = np.random.default_rng(seed)
    typical = np.array([0.6, 9.0, 0.9, 0.1, 0.15, 0.3, 0.2], np.float32)
    ms = typical * rng.gamma(12, 1 / 12, (300, 7)).astype(np.float32)
    ms[200, 0] = 28.0
    return ms


def adapting() -> Telemetry:
    """After a failed attempt: flagged chunks, a threshold, half of the gradient steps."""
    t = np.arange(HORIZON + 1)
    values = 0.3 + 0.4 * np.exp(-(((t - 70) / 28) ** 2)) + 0.01 * np.sin(t)
    changes = values[H:] - values[:-H]
    threshold = float(np.percentile(changes, 10))
    flagged = tuple(int(i) for i in np.flatnonzero(changes <= threshold))
    steps = tuple(
        AdaptationStep(step=i, steps=10, loss=0.693 - 0.012 * i, winner_error=0.412 - 0.003 * i,
                       loser_error=0.398 + 0.006 * i)
        for i in range(1, 7)
    )  # fmt: skip
    return replace(
        running(HORIZON, 2), state=State.ADAPTING, values=values, value_changes=changes, threshold=threshold,
        flagged=flagged, adaptation=steps, adaptation_status="update", pairs=8 * len(flagged), homing_progress=0.63,
        allowed=(Intent.STOP, Intent.PAUSE, Intent.MARK_SUCCESS, Intent.SKIP_TRIAL, Intent.QUIT),
    )  # fmt: skip


def stopped() -> Telemetry:
    return replace(running(), state=State.STOPPED, allowed=(Intent.STOP, Intent.RESUME, Intent.QUIT))


def rows() -> tuple[TrialRow, ...]:
    return (
        TrialRow(trial=1, scene_seed=1000, attempts=1, success=True, judged_by="twin", flagged=0, seconds=5.1),
        TrialRow(trial=2, scene_seed=1001, attempts=2, success=True, judged_by="twin", flagged=15, seconds=16.4),
        TrialRow(trial=3, scene_seed=1002, attempts=5, success=False, judged_by="horizon", flagged=58, seconds=61.0),
    )


def lines() -> tuple[LogLine, ...]:
    return (
        LogLine(stamp=-70.0, level="info", text="trial 3: attempt 5 failed at the horizon"),
        LogLine(stamp=-9.0, level="warning", text="4 ticks starved while the policy warmed up"),
        LogLine(stamp=-4.2, level="info", text="trial 4, scene 1003: attempt 1 begins"),
    )


def cube(size: float) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float32) * size / 2
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6],
             [0, 6, 4], [1, 5, 7], [1, 7, 3]]  # fmt: skip
    return corners, np.array(faces, dtype=np.int32)


class Stage:
    """Publishes at 15 Hz from its own thread; `telemetry` is what the app says, `intents` and `stops` what it heard."""

    def __init__(self, folder: Path, bodies: int = 14) -> None:
        self.telemetry: Telemetry | None = running()
        self.view_on = True
        self.advance = False
        """Let the attempt's tick go on by itself."""
        self.mode = RobotMode.TRACKING
        self.cameras: dict[str, CameraHealth] = {}
        """Empty, as on the twin."""
        self.intents: list[OperatorIntent] = []
        self.present: list[PagePresence] = []
        self.words: list[Any] = []
        """Nudges, marks and wishes."""
        self.stops: list[StopRequest] = []
        self.stop_answers = True
        self._bodies = bodies
        self._context: zmq.Context[Any] = zmq.Context()
        at = Endpoints.in_folder(folder)
        self._pub = self._bind(zmq.PUB, at.telemetry)
        self._views = self._bind(zmq.PUB, at.view)
        self._geometry = self._bind(zmq.REP, at.geometry)
        self._pull = self._bind(zmq.PULL, at.intents)
        self._rep = self._bind(zmq.REP, at.stop)
        self._ended = threading.Event()
        self._threads = [threading.Thread(target=f, daemon=True) for f in (self._publish, self._serve_stop)]
        for thread in self._threads:
            thread.start()

    def _bind(self, kind: int, endpoint: str) -> Any:
        socket = self._context.socket(kind)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RCVTIMEO, 50)
        socket.bind(endpoint)
        return socket

    def _publish(self) -> None:
        seq = 0
        while not self._ended.wait(1 / 15):
            seq += 1
            now = time.monotonic()
            if self.telemetry is not None:
                t = self.telemetry
                if self.advance and t.state is State.RUNNING:
                    t = self.telemetry = replace(running((t.tick + 2) % HORIZON, t.attempt), history=t.history)
                log = tuple(replace(line, stamp=now + line.stamp) for line in t.log)
                self._pub.send(pack(replace(t, seq=seq, stamp=now, log=log)))
            if self.view_on:
                self._views.send(pack(self._view(seq, now)))
            self._answer()

    def _view(self, seq: int, now: float) -> View:
        poses = np.zeros((self._bodies, 7))
        poses[:, 0] = 0.25 + 0.25 * np.cos(now + np.arange(self._bodies))
        poses[:, 1] = 0.25 * np.sin(now + np.arange(self._bodies))
        poses[:, 2] = np.linspace(0.05, 0.6, self._bodies)
        poses[:, 6] = 1.0
        latched = self.mode is RobotMode.LATCHED
        status = RobotStatus(mode=self.mode, reason="STOP by the operator" if latched else "")
        jpegs = {name: picture(name, seq) for name in ("front", "wrist")}
        return View(seq=seq, stamp=now, jpegs=jpegs, body_poses=poses, status=status, cameras=self.cameras)

    def _answer(self) -> None:
        while self._pull.poll(0):
            message = unpack(self._pull.recv())
            if isinstance(message, OperatorIntent):
                self.intents.append(message)
            elif isinstance(message, PagePresence):
                self.present.append(message)
            else:
                self.words.append(message)
        if self._geometry.poll(0):
            assert isinstance(unpack(self._geometry.recv()), GeometryRequest)
            vertices, faces = cube(0.08)
            meshes = tuple(
                BodyMesh(body=b, vertices=vertices, faces=faces, rgba=(0.7, 0.75, 0.8, 1.0))
                for b in range(self._bodies)
            )
            self._geometry.send(pack(SceneGeometry(meshes=meshes, body_names=tuple(map(str, range(self._bodies))))))

    def _serve_stop(self) -> None:
        while not self._ended.is_set():
            try:
                request = unpack(self._rep.recv())
            except zmq.ZMQError:
                continue
            self.stops.append(request)
            self.mode = RobotMode.LATCHED
            if self.stop_answers:
                self._rep.send(pack(StopAck(latched=time.monotonic())))

    def close(self) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join(timeout=2)
        self._context.destroy(linger=0)


def picture(name: str, seq: int, size: int = 320) -> bytes:
    """A moving test card, said to be one."""
    image = np.full((size, size, 3), (46, 40, 36), np.uint8)
    x = int(size / 2 + size / 3 * math.sin(seq / 12))
    cv2.circle(image, (x, size // 2), size // 12, (80, 80, 220), -1, cv2.LINE_AA)
    cv2.putText(image, f"test card: {name}", (20, size - 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (190, 190, 190), 1)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()


def main(folder: Path, scenes: bool) -> None:
    stage = Stage(folder)
    stage.advance = True
    while True:
        time.sleep(5)
        if scenes:
            stage.telemetry = adapting() if stage.telemetry and stage.telemetry.state is State.RUNNING else running(0)


if __name__ == "__main__":
    main(Path(sys.argv[1]), "--scenes" in sys.argv)
