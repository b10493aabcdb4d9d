"""A plan's card and the scene's overlay: what they say, and that they are on the page when they should be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from ui_process import PageProcess
from ui_stage import Stage, picture, running

from far_app.recording.images import encode_png
from far_app.session_states import Intent, State
from far_app.trial_plan.shown import ArmShown, DifferenceShown, PlanShown, SceneShown
from ui.raw_client import RawClient
from ui.scene_overlay import overlays, words
from ui.trials_panel import card

Start = Callable[..., PageProcess]

ARMS = (
    ArmShown(label="A", trials=4, solved=(1, 3), low=(0.05, 0.30), high=(0.70, 0.95)),
    ArmShown(label="B", trials=0, solved=(0,), low=(0.0,), high=(1.0,)),
)
PAIR = DifferenceShown(
    left="A", right="B", pairs=12, mean=0.25, low=-0.05, high=0.55, only_left=4, only_right=1, p=0.375, left_to_go=96
)  # fmt: skip
PLAN = PlanShown(
    name="ab", done=7, total=24, blind=True, label="B", scene="seed 7", repetition=2, repetitions=3, arms=ARMS,
    differences=(PAIR,),
)  # fmt: skip


def test_the_card_tells_how_far_it_is_the_figures_and_what_comes():
    html = card(PLAN)
    assert "7 of 24 trials · blinded" in html and "<b>B</b>seed 7, 2 of 3" in html
    assert "1/4" in html and "3/4" in html and "75 % [30, 95]" in html and "no trial yet" in html
    assert "+25 points [-5, +55] on 12 pairs" in html and "about 96 trials to ± 10 points" in html
    assert 'data-done="7" data-total="24"' in html


def test_foreign_words_are_escaped_and_a_done_plan_tells_its_letters():
    html = card(replace(PLAN, name="<script>", label="", revealed=(("A", "ours"), ("B", "<b>"))))
    assert "<script>" not in html and "A is ours · B is &lt;b&gt;" in html and "op-planned" not in html
    assert "<script>" not in words(SceneShown(name="<script>"))


def png(x: int) -> bytes:
    image = np.full((84, 84, 3), 120, np.uint8)
    image[:30] = 200
    image[40:52, x : x + 12] = (220, 30, 30)
    return encode_png(image)


def jpeg(x: int) -> bytes:
    bgr = cv2.imdecode(np.frombuffer(png(x), np.uint8), cv2.IMREAD_COLOR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


def test_the_overlay_shows_start_blend_and_what_differs():
    (shown,) = overlays({"front": png(10)}, {"front": jpeg(50)}, 0.25, tile=84)
    (alone,) = overlays({"front": png(10)}, {"front": jpeg(50)}, 0.0, tile=84)
    assert shown.shape == (84, 2 * 84 + 4, 3)
    over, differing = shown[:, :84], shown[:, 88:]
    assert alone[46, 16, 0] > 200 and alone[46, 56, 0] < 140, "the start image alone"
    assert 120 < over[46, 56, 0] < 170 and over[46, 16, 0] > over[46, 56, 0], "a quarter of the live one over it"
    red = (differing[..., 0].astype(int) - differing[..., 1]) > 80
    assert red[46, 16] and red[46, 56] and red[:36].sum() == 0, "where the cube was and where it is, and nowhere else"
    (same,) = overlays({"front": png(10)}, {"front": jpeg(10)}, 0.5, tile=84)
    assert not ((same[:, 88:, 0].astype(int) - same[:, 88:, 1]) > 80).any()


def test_a_camera_without_a_picture_shows_its_start_alone_and_nothing_without_a_start():
    assert overlays({}, {"front": jpeg(1)}, 0.5) == ()
    (dark,) = overlays({"front": png(10)}, {}, 0.5, tile=84)
    np.testing.assert_array_equal(dark[:, :84], decoded(png(10)))


def test_the_words_say_whether_it_matches():
    scene = SceneShown(name="left", reference={"front": b"x"}, scores={"front": 0.93, "wrist": 0.7}, limit=0.8)
    assert "front 0.93 · wrist 0.70 (limit 0.80): not yet" in words(scene) and 'data-tone="warn"' in words(scene)
    assert "it matches" in words(replace(scene, scores={"front": 0.93, "wrist": 0.8}))
    assert "its start is kept" in words(SceneShown(name="left"))


def test_plan_and_scene_come_and_go_on_the_page_and_only_who_holds_control_moves_the_slider(
    start_page: Start, stage: Stage
) -> None:
    page = start_page()
    client = RawClient(page.url)
    assert client.read(20, lambda: "RUNNING" in client.html("op-state"))

    def visible(part: str) -> bool:
        return any(part in str(w.get("content", "")) and w.get("visible") for w in client.widgets.values())

    assert not visible("op-plan") and not visible("op-scene")
    scene = SceneShown(
        name="left", reference={"front": encode_png(decoded(picture("front", 0)))}, scores={"front": 0.4}
    )
    awaiting = replace(running(0), state=State.AWAITING_SCENE, plan=PLAN, scene=scene, allowed=(Intent.SCENE_READY,))
    stage.telemetry = awaiting
    assert client.read(10, lambda: visible("op-plan") and visible("op-scene"))
    slider = next(u for u, w in client.widgets.items() if w.get("type") == "GuiSliderMessage" and w["max"] == 1.0)
    assert client.read(10, lambda: client.widgets[slider]["visible"])
    other = RawClient(page.url)
    assert other.read(10, lambda: "op-scene" in str(other.widgets))
    other.send({"type": "GuiUpdateMessage", "uuid": slider, "updates": {"value": 1.0}})
    assert client.read(10, lambda: "a slider refused" in client.html("op-loop"))
    stage.telemetry = replace(running(), plan=PLAN)
    assert client.read(10, lambda: visible("op-plan") and not visible("op-scene")), "an attempt has no overlay"
    stage.telemetry = running()
    assert client.read(10, lambda: not visible("op-plan"))


def decoded(raw: bytes) -> np.ndarray:
    return cv2.cvtColor(cv2.imdecode(np.frombuffer(raw, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
