"""Building a real scene again: how it is to look, how well the live cameras match, and what is kept of it.

The references are the plan's own pictures, a recorded attempt's first observation, or, where the plan gives neither,
the start of the scene's first trial, in whatever session that was. Compared at the policy's picture size.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from pathlib import Path

import cv2
import numpy as np

from far_app.errors import ConfigError, RecordingError
from far_app.recording.attempt_reader import read_attempt
from far_app.recording.images import decode_png, encode_png
from far_app.recording.reader import SessionRecording
from far_app.recording.scene_file import SceneAccepted
from far_app.recording.session_folder import attempt_name
from far_app.trial_plan.plan import Scene, TrialPlan
from far_app.trial_plan.scene_match import Picture, match
from far_app.trial_plan.shown import SceneShown
from far_app.types import Observation

CONFIRM = 10.0
"""Seconds within which a second Scene ready accepts a scene below the limit."""
LOOKS = 0.2
"""Seconds between two scores for the page."""


class References:
    """How each scene is to look. Raises ConfigError for a picture or recording that cannot be read."""

    def __init__(self, plan: TrialPlan, sessions: Iterable[SessionRecording]) -> None:
        self._looks: dict[str, Mapping[str, Picture]] = {
            scene.name: look for scene in plan.scenes if (look := given(scene, plan))
        }
        for session in sessions:
            for entry in session.log:
                if entry.event == "scene_matched" and not entry.detail.get("scores"):
                    files = entry.detail.get("pictures", {})
                    where = f"{session.path}: scene '{entry.detail['scene']}'"
                    look = {camera: picture(session.path / str(name), where) for camera, name in files.items()}
                    self.keep(str(entry.detail["scene"]), look)

    def of(self, scene: str) -> Mapping[str, Picture]:
        """Empty where it has not been built yet."""
        return self._looks.get(scene, {})

    def keep(self, scene: str, look: Mapping[str, Picture]) -> None:
        """A scene's first start; a reference that is there stays."""
        self._looks.setdefault(scene, look)


class SceneGate:
    """One trial's: far_app.session.course.Gate."""

    def __init__(self, scene: str, references: References, limit: float) -> None:
        self.scene, self.limit = scene, limit
        self._references = references
        self._reference = references.of(scene)
        self._png = {camera: encode_png(np.ascontiguousarray(image)) for camera, image in self._reference.items()}
        self._scores: dict[str, float] = {}
        self._looked = self._warned = float("-inf")

    def look(self, observation: Observation) -> SceneShown:
        """How it matches now."""
        if time.monotonic() >= self._looked + LOOKS:
            self._looked = time.monotonic()
            self._scores = match(self._reference, observation.images)
        return SceneShown(name=self.scene, reference=self._png, scores=self._scores, limit=self.limit)

    def refusal(self, observation: Observation) -> str:
        """Why the operator's word is not taken yet; below the limit it takes two within CONFIRM seconds."""
        self._scores = match(self._reference, observation.images)
        worst = min(self._scores, key=self._scores.__getitem__, default="")
        low = bool(self._scores) and self._scores[worst] < self.limit
        if not low or time.monotonic() < self._warned + CONFIRM:
            return ""
        self._warned = time.monotonic()
        return (
            f"scene '{self.scene}' matches its start image by {self._scores[worst]:.2f} (camera {worst}), the limit is "
            f"{self.limit:.2f}: move things until it does, or press Scene ready once more within {CONFIRM:.0f} s to "
            "take it as it is; the recording keeps the score"
        )

    def accepted(self, observation: Observation) -> SceneAccepted:
        """What the recording keeps; the scene's first start becomes what later ones are held against."""
        images = {camera: np.array(image) for camera, image in observation.images.items()}
        if not self._reference:
            self._references.keep(self.scene, images)
        return SceneAccepted(scene=self.scene, scores=dict(self._scores), limit=self.limit, images=images)


def given(scene: Scene, plan: TrialPlan) -> dict[str, Picture]:
    """How the plan itself says that a scene looks. Raises ConfigError."""
    if scene.recording is None:
        return {c: picture(p, f"{plan.file}: scene '{scene.name}'.image") for c, p in scene.images.items()}
    where = f"{plan.file}: scene '{scene.name}'.recording"
    try:
        recording = read_attempt(scene.recording / attempt_name(scene.trial, 1))
    except RecordingError as error:
        raise ConfigError(f"{where}: {error}") from error
    look = {c: np.array(image) for c, image in recording.steps[0].observation.images.items()} if recording.steps else {}
    if not look:
        raise ConfigError(f"{where} is '{scene.recording}': trial {scene.trial} has no picture of its start")
    return look


def picture(file: Path, where: str) -> Picture:
    """RGB of a picture file. Raises ConfigError."""
    try:
        raw = file.read_bytes()
        if file.suffix.lower() == ".png":
            return decode_png(raw)
        bgr = cv2.imdecode(np.frombuffer(raw, np.uint8), cv2.IMREAD_COLOR) if raw else None
    except (OSError, RecordingError) as error:
        raise ConfigError(f"{where} is '{file}', which cannot be read: {error}") from error
    if bgr is None:
        raise ConfigError(f"{where} is '{file}', must be a PNG or JPEG picture")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
