"""A plan's card and the scene that is being rebuilt, in a real headless Chromium: large enough, nothing covered."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from test_page import ARGUMENTS, CHROMIUM
from test_trials_panel import PLAN, decoded
from ui_process import PageProcess, free_port, settles
from ui_stage import Stage, picture, running

from far_app.recording.images import encode_png
from far_app.session_states import Intent, State
from far_app.trial_plan.shown import SceneShown

sync_api = pytest.importorskip("playwright.sync_api", reason="pip install playwright (the dev extra)")
pytestmark = [
    pytest.mark.page,
    pytest.mark.skipif(not CHROMIUM.exists(), reason="no /usr/bin/chromium: apt-get install chromium"),
]
BOTH = SceneShown(
    name="left", scores={"front": 0.4, "wrist": 0.7},
    reference={name: encode_png(decoded(picture(name, 0))) for name in ("front", "wrist")},
)  # fmt: skip
AWAITING = replace(
    running(0), state=State.AWAITING_SCENE, plan=PLAN, scene=BOTH, allowed=(Intent.SCENE_READY,),
    refusal="scene 'left' matches its start image by 0.40 (camera front), the limit is 0.80: move things until it "
    "does, or press Scene ready once more within 10 s to take it as it is; the recording keeps the score",
)  # fmt: skip


@pytest.fixture(scope="module")
def opened() -> Iterator[tuple[Any, Stage]]:
    with TemporaryDirectory(prefix="far") as name, sync_api.sync_playwright() as playwright:
        source = Stage(Path(name))
        source.telemetry = AWAITING
        process = PageProcess(Path(name), free_port())
        chromium = playwright.chromium.launch(executable_path=str(CHROMIUM), args=ARGUMENTS)
        page = chromium.new_page(viewport={"width": 1280, "height": 720})
        page.goto(process.url)
        page.wait_for_selector("div:has(> .overlay-2) + div img", timeout=60_000, state="attached")
        yield page, source
        chromium.close()
        process.kill()
        source.close()


def boxes(tab: Any, *selectors: str) -> list[tuple[float, float, float, float]]:
    """Left, top, right and bottom of each."""
    return tab.evaluate(
        """selectors => selectors.map(s => { const r = document.querySelector(s).getBoundingClientRect();
            return [r.left, r.top, r.right, r.bottom]; })""", list(selectors),
    )  # fmt: skip


@pytest.mark.parametrize(("width", "height", "tile"), [(1280, 720, 200), (1024, 768, 180), (768, 1024, 180)])
def test_two_cameras_overlays_are_large_within_their_card_and_cover_no_word(
    opened: tuple[Any, Stage], width: int, height: int, tile: int
) -> None:
    tab = opened[0]
    tab.set_viewport_size({"width": width, "height": height})
    overlays = [f"div:has(> .overlay-{n}) + div img" for n in (1, 2)]

    def all_within_and_apart() -> None:
        card, first, second, words, why = boxes(
            tab, "#op-scene", *overlays, "#op-scene p:first-of-type", "#op-scene p.why"
        )  # fmt: skip
        for box in (first, second):
            assert box[3] - box[1] >= tile and box[2] - box[0] >= 2 * tile
            assert card[0] < box[0] and box[2] <= card[2] and words[3] <= box[1] and box[3] <= why[1]
        apart = [*boxes(tab, ".far-tabs", "#op-plan"), card, *boxes(tab, "#op-stop", "#op-adapt", "#op-loop")]
        for i, a in enumerate(apart):
            assert -1 <= a[0] < a[2] <= width + 1 and -1 <= a[1] < a[3] <= height + 1
            for b in apart[i + 1 :]:
                assert min(a[2], b[2]) - max(a[0], b[0]) <= 1 or min(a[3], b[3]) - max(a[1], b[1]) <= 1, (a, b)
        assert first[2] <= second[0] or first[3] <= second[1]

    settles(all_within_and_apart)


def test_an_open_panel_lies_over_the_scene_and_the_plots_come_back_with_the_attempt(opened: tuple[Any, Stage]) -> None:
    tab, source = opened
    tab.set_viewport_size({"width": 1280, "height": 720})
    plots = "getComputedStyle(document.querySelector('div:has(> .mark-value) + div')).visibility"
    assert tab.evaluate(plots) == "hidden"
    tab.click("#far-tab-marks summary")
    tab.wait_for_selector("#op-marks", state="visible")

    def nothing_covered() -> None:
        covered = tab.evaluate(
            """() => { const card = document.querySelector('#op-marks').getBoundingClientRect();
                return [...document.querySelectorAll('button.mantine-Button-root')].filter(b => {
                  const r = b.getBoundingClientRect();
                  const within = r.width > 0 && r.left >= card.left && r.right <= card.right && r.top >= card.top
                    && r.bottom <= card.bottom;
                  return within && !b.contains(document.elementFromPoint(r.left + r.width / 2, r.top + r.height / 2));
                }).map(b => b.innerText); }"""
        )
        assert covered == []

    settles(nothing_covered)
    tab.click("#far-tab-marks summary")
    source.telemetry = replace(running(), plan=PLAN)
    tab.wait_for_selector("#op-state[data-state='RUNNING']")
    tab.wait_for_function(f"() => {plots} === 'visible'")
