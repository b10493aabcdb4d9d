"""Building a real scene again: the live camera over its start image, and where the two differ, for each camera.

Shown while a plan waits for a scene. The slider says how much of the live picture covers the start image: at 0 that one
is seen alone. What is marked as different is what the score counts (far_app/trial_plan/scene_match.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import cv2
import numpy as np
import viser
from jaxtyping import UInt8

from far_app.session_states import State
from far_app.telemetry import Telemetry, View
from far_app.trial_plan.scene_match import TOLERANCE, difference
from far_app.trial_plan.shown import SceneShown
from ui.page_server import Presses

TILE = 320
"""Pixels of each picture's side."""
CAMERAS = 2
"""That fit, beside or below each other as trials.css has it."""
_RED = np.array([255.0, 45.0, 45.0])


class SceneOverlay:
    """Its widgets on the console; `show` is called from the page's thread."""

    def __init__(self, gui: viser.GuiApi, presses: Presses) -> None:
        self._blend = 0.5
        self._words = gui.add_html("", visible=False)
        self._pictures: list[tuple[viser.GuiHtmlHandle, viser.GuiImageHandle]] = []
        for number in range(1, CAMERAS + 1):
            slot = gui.add_html(f'<div class="far-slot slot-overlay overlay-{number}"></div>', visible=False)
            blank = np.zeros((8, 8, 3), np.uint8)
            self._pictures.append((slot, gui.add_image(blank, format="jpeg", visible=False)))
        self._label = gui.add_html('<div class="far-slot slot-blend">live over start image</div>', visible=False)
        self._slider = gui.add_slider(" ", min=0.0, max=1.0, step=0.05, initial_value=self._blend, visible=False)
        presses.on_value(self._slider, self._slid)

    def _slid(self, value: float) -> None:
        self._blend = value

    def show(self, telemetry: Telemetry | None, view: View | None) -> None:
        scene = telemetry.scene if telemetry is not None and telemetry.state is State.AWAITING_SCENE else None
        self._words.visible = scene is not None
        drawn: Sequence[np.ndarray] = ()
        if scene is not None:
            self._words.content = words(scene, telemetry.refusal if telemetry is not None else "")
            drawn = overlays(scene.reference, view.jpegs if view is not None else {}, self._blend)
        self._label.visible = self._slider.visible = bool(drawn)
        for number, (slot, picture) in enumerate(self._pictures):
            slot.visible = picture.visible = number < len(drawn)
            if number < len(drawn):
                picture.image = drawn[number]


def words(scene: SceneShown, refusal: str = "") -> str:
    """How well it matches, by camera, and why the last Scene ready was not taken."""
    if not scene.reference:
        text, tone = (
            "first trial on this scene: build it, its start is kept and later trials are held against it",
            "idle",
        )
    else:
        tone = "good" if scene.score is not None and scene.score >= scene.limit else "warn"
        scores = " · ".join(f"{camera} {score:.2f}" for camera, score in scene.scores.items())
        text = f"match {scores} (limit {scene.limit:.2f}): {'it matches' if tone == 'good' else 'not yet'}"
    heads = "<p>left: live over start image · right: what differs, in red</p>" * bool(scene.reference)
    why = f'<p class="why">{escape(refusal)}</p>' if refusal else ""
    pictured = "pictured " * bool(scene.reference)
    return (
        f'<div class="far-card far-scene {pictured}tone-{tone}" id="op-scene" data-tone="{tone}">'
        f"<h2>Scene {escape(scene.name)} <em>{escape(text)}</em></h2>{heads}{why}</div>"
    )


def overlays(
    reference: Mapping[str, bytes], live: Mapping[str, bytes], blend: float, tile: int = TILE
) -> tuple[UInt8[np.ndarray, "H W 3"], ...]:
    """For each camera with a start image: live over it, and the difference beside that. RGB."""
    drawn = []
    for camera, png in list(reference.items())[:CAMERAS]:
        start, now = picture(png), picture(live.get(camera, b""))
        if start is not None:
            drawn.append(_overlay(start, start if now is None else now, blend if now is not None else 0.0, tile))
    return tuple(drawn)


def picture(raw: bytes) -> UInt8[np.ndarray, "H W 3"] | None:
    """RGB of a JPEG or PNG; None for what is no picture."""
    bgr = cv2.imdecode(np.frombuffer(raw, np.uint8), cv2.IMREAD_COLOR) if raw else None
    return None if bgr is None else cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def _overlay(start: np.ndarray, now: np.ndarray, blend: float, tile: int) -> UInt8[np.ndarray, "H W 3"]:
    height = max(1, round(tile * start.shape[0] / start.shape[1]))
    there, here = (cv2.resize(p, (tile, height), interpolation=cv2.INTER_LINEAR) for p in (start, now))
    over = cv2.addWeighted(there, 1.0 - blend, here, blend, 0.0)
    differing = cv2.resize(difference(start, now), (tile, height), interpolation=cv2.INTER_NEAREST)
    grey = cv2.cvtColor(here, cv2.COLOR_RGB2GRAY)[..., None].astype(float) * 0.6 + 30.0
    share = np.clip(differing / (2 * TOLERANCE), 0.0, 1.0)[..., None] * (differing > TOLERANCE)[..., None]
    return side_by_side((over, (grey * (1.0 - share) + _RED * share).astype(np.uint8)))


def side_by_side(pictures: Sequence[np.ndarray]) -> UInt8[np.ndarray, "H W 3"]:
    """With a thin line in between."""
    line = np.full((pictures[0].shape[0], 4, 3), 17, np.uint8)
    return np.hstack([part for p in pictures for part in (p, line)][:-1])
