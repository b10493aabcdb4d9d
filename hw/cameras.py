"""Cameras as the program sees them: a name, a size, and the newest frame. The twin's draw a snapshot when asked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from far_app.errors import RobotError
from far_app.protocols import Frame
from hw.plant import PlantView


@dataclass(frozen=True, kw_only=True)
class Moment:
    """One snapshot of the plant."""

    snapshot: Any
    stamp: float
    """When it was taken, seconds on the robot's clock."""
    seq: int


class TwinCamera:
    """far_app.protocols.Camera over a view of the twin. Use it in the view's own thread."""

    def __init__(self, name: str, size: int, view: PlantView, newest: Callable[[], Moment]) -> None:
        self.name, self.height, self.width = name, size, size
        self._view, self._newest = view, newest
        self._frame: Frame | None = None
        self._closed = False

    def frame(self) -> Frame:
        """The newest moment's picture; drawn once."""
        if self._closed:
            raise RobotError(f"camera {self.name} was closed")
        moment = self._newest()
        if self._frame is None or self._frame.seq != moment.seq:
            image = self._view.image(moment.snapshot, self.name, self.height)
            self._frame = Frame(image=image, stamp=moment.stamp, seq=moment.seq)
        return self._frame

    def close(self) -> None:
        self._closed = True
