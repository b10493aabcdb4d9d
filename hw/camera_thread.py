"""The camera thread: owns the GL context, draws each newest snapshot for the policy, and for the operator in between.

A rig with cameras of its own (hw/hardware_view.py) goes the same way: in place of a drawing there is its newest frame,
with the frame's own timestamp, and a camera that is lost is a fault, told again while it lasts; the thread goes on.

Policy pictures come first and are handed on at once. Operator pictures are drawn one camera at a time after them, and
only while someone is subscribed, so that a watching page adds at most one picture to a tick.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import zmq

from far_app.config import TaskConfig
from far_app.errors import FarError, GraphicsError
from far_app.protocols import Camera
from far_app.scheduling import DRAWING_NICENESS, PROMPT_NICENESS, nice
from far_app.telemetry import SceneGeometry, View
from far_app.wire import pack
from hw.cameras import Moment, TwinCamera
from hw.hardware_view import HardwareView
from hw.plant import PlantView
from hw.rig import RigConfig
from hw.servo_thread import ServoThread

log = logging.getLogger(__name__)

JPEG_QUALITY = 80
TELL_AGAIN = 1.0
"""Seconds after which a camera that is still lost is told again: the operator may have resumed meanwhile."""


@dataclass(frozen=True, kw_only=True)
class Pictures:
    """What the policy sees of one moment."""

    images: Mapping[str, np.ndarray]
    stamp: float
    """Of the oldest among them."""
    seq: int


class CameraThread:
    """Draws until closed. `geometry` is there once started; `failed` says why drawing ended."""

    def __init__(
        self, make_view: Callable[[], PlantView], rig: RigConfig, task: TaskConfig, servo: ServoThread,
        context: zmq.Context[zmq.Socket[bytes]], endpoint: str, on_pictures: Callable[[Pictures], None],
        on_failure: Callable[[str], None],
    ) -> None:  # fmt: skip
        self._make_view, self._rig, self._task, self._servo = make_view, rig, task, servo
        self._context, self._endpoint = context, endpoint
        self._on_pictures, self._on_failure = on_pictures, on_failure
        self._moment = servo.newest.moment
        self._ready = threading.Event()
        self._error: FarError | None = None
        self._closing = False
        self._jpegs: dict[str, bytes] = {}
        self._views = 0
        self._watched = False
        self._told = -TELL_AGAIN
        self.geometry: SceneGeometry | None = None
        self.drawn = 0
        self._seconds = 0.0
        self._thread = threading.Thread(target=self._run, name="cameras", daemon=True)

    def start(self, timeout: float = 30.0) -> None:
        """Returns with the first pictures drawn; raises GraphicsError where that cannot be."""
        self._thread.start()
        if not self._ready.wait(timeout):
            raise GraphicsError(f"the cameras drew nothing within {timeout:.0f} s; see `far doctor`")
        if self._error is not None:
            raise self._error

    @property
    def milliseconds(self) -> float:
        """Time to draw the policy's pictures of one moment, mean."""
        return 1e3 * self._seconds / max(1, self.drawn)

    def close(self) -> None:
        self._closing = True
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        nice(DRAWING_NICENESS)  # inherited by the threads that GL contexts start
        try:
            view = self._make_view()
            policy = self._cameras(view, self._rig.policy_image)
            operator = self._cameras(view, self._rig.operator_image, quick=True)
            self.geometry = view.geometry()
            self._draw(policy)
            for camera in operator:
                camera.frame()
            nice(PROMPT_NICENESS)
        except Exception as error:  # GL back ends raise what they like
            self._error = error if isinstance(error, FarError) else GraphicsError(
                f"the cameras could not be set up ({type(error).__name__}: {error}); see `far doctor`"
            )  # fmt: skip
            self._ready.set()
            return
        self._ready.set()
        socket = self._context.socket(zmq.XPUB)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.SNDHWM, 4)
        socket.bind(self._endpoint)
        try:
            self._loop(view, policy, operator, socket)
        except Exception as error:
            log.exception("the camera thread ended")
            self._on_failure(f"the cameras are lost ({type(error).__name__}: {error}); restart the program")
        finally:
            socket.close()
            view.close()

    def _cameras(self, view: PlantView, size: int, *, quick: bool = False) -> list[Camera]:
        if isinstance(view, HardwareView):
            return [view.camera(name, size, quick=quick) for name in self._task.cameras]
        return [TwinCamera(name, size, view, lambda: self._moment) for name in self._task.cameras]

    def _loop(self, view: PlantView, policy: list[Camera], operator: list[Camera], socket: zmq.Socket[bytes]) -> None:
        due = time.monotonic()
        turn = 0
        share = 1.0 / (self._rig.operator_rate * max(1, len(operator)))
        while not self._closing:
            moment = self._servo.wait_for_moment(after=self._moment.seq, timeout=0.1)
            if moment is None:
                continue
            self._moment = moment
            self._draw(policy)
            self._look_after(view)
            if self._anyone_watching(socket) and time.monotonic() >= due:
                due = max(due + share, time.monotonic() - share)
                if operator:  # an arm without cameras still shows its status
                    self._draw_for_operator(operator[turn])
                    turn = (turn + 1) % len(operator)
                if turn == 0:
                    socket.send(pack(self._view(view, moment)), zmq.NOBLOCK)

    def _anyone_watching(self, socket: zmq.Socket[bytes]) -> bool:
        while socket.poll(0):
            self._watched = socket.recv()[:1] == b"\x01"
        return self._watched

    def _draw(self, cameras: list[Camera]) -> None:
        began = time.monotonic()
        frames = {camera.name: camera.frame() for camera in cameras}
        self._seconds += time.monotonic() - began
        self.drawn += 1
        stamp = min((frame.stamp for frame in frames.values()), default=self._moment.stamp)
        images = {name: frame.image for name, frame in frames.items()}
        self._on_pictures(Pictures(images=images, stamp=stamp, seq=self._moment.seq))

    def _look_after(self, view: PlantView) -> None:
        """A lost camera is a fault; the pictures of the others go on."""
        now = time.monotonic()
        if isinstance(view, HardwareView) and now > self._told + TELL_AGAIN and (trouble := view.trouble(now)):
            self._told = now
            self._on_failure(trouble)

    def _draw_for_operator(self, camera: Camera) -> None:
        bgr = cv2.cvtColor(camera.frame().image, cv2.COLOR_RGB2BGR)
        _, jpeg = cv2.imencode(".jpg", bgr, (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))
        self._jpegs[camera.name] = jpeg.tobytes()

    def _view(self, view: PlantView, moment: Moment) -> View:
        self._views += 1
        with self._servo.locked() as controller:
            status = controller.status()
        return View(
            seq=self._views, stamp=moment.stamp, jpegs=dict(self._jpegs), body_poses=view.body_poses(moment.snapshot),
            status=status, cameras=view.health(time.monotonic()) if isinstance(view, HardwareView) else {},
        )  # fmt: skip
