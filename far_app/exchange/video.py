"""Frames of a video by number, in order, as LeRobot's datasets keep them: several episodes behind each other."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from far_app.errors import RecordingError


class VideoFrames:
    """One camera's videos; episodes are asked for in the order in which they lie."""

    def __init__(self) -> None:
        self._path: Path | None = None
        self._video: cv2.VideoCapture | None = None
        self._next = 0

    def read(self, path: Path, first: int, count: int) -> np.ndarray:
        """RGB (count, H, W, 3) from frame `first` on, counted one by one: seeking is not exact in every codec. Raises
        RecordingError when they are not there or the codec is not known."""
        if path != self._path or first < self._next or self._video is None:
            self._path, self._video, self._next = path, cv2.VideoCapture(str(path)), 0
        frames = []
        while self._next < first + count:
            wanted = self._next >= first
            there, frame = self._video.read() if wanted else (self._video.grab(), None)
            if not there:
                raise RecordingError(
                    f"{path} ends (or cannot be decoded) after {self._next} frames, {first + count} are needed"
                )
            self._next += 1
            if frame is not None:
                frames.append(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB))
        return np.stack(frames)
