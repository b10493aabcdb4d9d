"""The page in a real headless Chromium: what an operator sees, presses, and is warned of."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from ui_process import PageProcess, free_port, settles, wait_until
from ui_stage import Stage, adapting, running, stopped

from far_app.session_states import Intent, State
from far_app.telemetry import CameraHealth
from far_app.types import RobotMode
from ui.keys import Page, keys_of

sync_api = pytest.importorskip("playwright.sync_api", reason="pip install playwright (the dev extra)")
CHROMIUM = Path("/usr/bin/chromium")
ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]

pytestmark = [
    pytest.mark.page,
    pytest.mark.skipif(not CHROMIUM.exists(), reason="no /usr/bin/chromium: apt-get install chromium"),
]
Start = Callable[..., PageProcess]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=str(CHROMIUM), args=ARGUMENTS)
        yield chromium
        chromium.close()


@pytest.fixture(scope="module")
def opened(browser: Any) -> Iterator[tuple[Any, Stage]]:
    """One ui process, one open page and its test source for most tests of this file; requests are recorded."""
    with TemporaryDirectory(prefix="far") as name:
        source = Stage(Path(name))
        process = PageProcess(Path(name), free_port())
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        page.requests = []
        page.on("request", lambda request: page.requests.append(request.url))
        page.goto(process.url)
        page.wait_for_selector("#op-state[data-state='RUNNING']", timeout=60_000)
        yield page, source
        page.close()
        process.kill()
        source.close()


@pytest.fixture
def tab(opened: tuple[Any, Stage], source: Stage) -> Any:
    """The open page, back at a first attempt under way."""
    page = opened[0]
    page.evaluate("document.activeElement.blur()")
    page.wait_for_selector("#op-state[data-state='RUNNING'][data-tick='87']")
    page.wait_for_selector("#op-stop:has-text('space key')")
    page.wait_for_selector("button:has-text('Pause'):has-text('key P'):not(:disabled)")  # a moment after the state
    return page


@pytest.fixture
def source(opened: tuple[Any, Stage]) -> Stage:
    stage = opened[1]
    stage.telemetry, stage.mode = running(), RobotMode.TRACKING
    stage.intents.clear()
    stage.stops.clear()
    return stage


def heard(source: Stage) -> list[Intent]:
    """What the app was asked, but for STOP (one of an earlier test may still be on its way)."""
    return [i.intent for i in source.intents if i.intent is not Intent.STOP]


def button(page: Any, label: str) -> Any:
    return page.get_by_role("button", name=re.compile(f"^{label}"))


def test_the_state_is_shown_and_followed(tab: Any, source: Stage) -> None:
    source.telemetry = adapting()
    tab.wait_for_selector("#op-state[data-state='LEARNING'][data-attempt='2']")
    assert "6 of 10" in tab.inner_text("#op-adapt")
    assert "not solved" in tab.inner_text("#op-history")
    source.telemetry = running(12, 3)
    tab.wait_for_selector("#op-state[data-state='RUNNING'][data-attempt='3'][data-tick='12']")


def test_stop_latches_by_click_and_by_space(tab: Any, source: Stage) -> None:
    button(tab, "STOP").click()
    assert wait_until(lambda: len(source.stops) == 1)
    tab.wait_for_selector("#op-stop:has-text('latched in')")
    tab.keyboard.press("Space")
    assert wait_until(lambda: len(source.stops) >= 2)
    assert source.stops[-1].source == "page: space key"


def test_space_stops_and_does_not_press_the_focused_button(tab: Any, source: Stage) -> None:
    pause = button(tab, "Pause")
    pause.click()
    assert wait_until(lambda: heard(source) == [Intent.PAUSE])
    tab.keyboard.press("Space")
    assert wait_until(lambda: len(source.stops) == 1)
    tab.wait_for_selector("#op-stop:has-text('latched in')")
    assert heard(source) == [Intent.PAUSE]


@pytest.mark.parametrize(
    ("label", "key", "intent"),
    [
        ("Pause", "p", Intent.PAUSE),
        ("Mark success", "s", Intent.MARK_SUCCESS),
        ("Mark failure", "f", Intent.MARK_FAILURE),
        ("Skip trial", "k", Intent.SKIP_TRIAL),
    ],
)
def test_every_live_control_sends_its_intent(tab: Any, source: Stage, label: str, key: str, intent: Intent) -> None:
    button(tab, label).click()
    assert wait_until(lambda: heard(source) == [intent])
    tab.keyboard.press(key)
    assert wait_until(lambda: heard(source) == [intent, intent])


@pytest.mark.parametrize(
    ("state", "label", "key", "intent"),
    [(State.PAUSED, "Resume", "r", Intent.RESUME), (State.AWAITING_SCENE, "Scene ready", "n", Intent.SCENE_READY)],
)
def test_a_control_that_waits_for_its_state_is_live_in_it(
    tab: Any, source: Stage, state: State, label: str, key: str, intent: Intent
) -> None:
    assert button(tab, label).is_disabled()
    source.telemetry = replace(running(), state=state, allowed=(Intent.STOP, intent, Intent.QUIT))
    tab.wait_for_selector(f"button:has-text('{label}'):not(:disabled)")
    button(tab, label).click()
    assert wait_until(lambda: heard(source) == [intent])
    tab.keyboard.press(key)
    assert wait_until(lambda: heard(source) == [intent, intent])


def test_ending_the_session_takes_a_second_click(tab: Any, source: Stage) -> None:
    button(tab, "End session").click()
    tab.wait_for_selector("button:has-text('click again')")
    assert heard(source) == []
    button(tab, "End session").click()
    assert wait_until(lambda: heard(source) == [Intent.QUIT])


def test_dead_controls_are_disabled_and_say_why(tab: Any, source: Stage) -> None:
    assert button(tab, "Resume").is_disabled()
    assert "nothing is held" in button(tab, "Resume").inner_text()
    source.telemetry = stopped()
    tab.wait_for_selector("#op-state[data-state='STOPPED']")
    tab.wait_for_selector("button:has-text('Mark success'):disabled")  # it comes a moment after the state's word
    assert "Resume first" in button(tab, "Mark success").inner_text()
    button(tab, "Resume").click()
    assert wait_until(lambda: heard(source) == [Intent.RESUME])


@pytest.mark.parametrize("state", [*State, None])
def test_no_control_is_dead_without_a_reason(tab: Any, source: Stage, state: State | None) -> None:
    """In every state of the session, and with no app at all."""
    source.telemetry = None if state is None else replace(running(5), state=state, allowed=(Intent.STOP,))
    tab.wait_for_selector("button:has-text('Pause'):disabled")

    def each_says_why() -> None:
        labels = tab.evaluate(
            """() => [...document.querySelectorAll('button.mantine-Button-root:disabled')]
                .filter(b => b.offsetWidth > 0 && getComputedStyle(b).visibility === 'visible').map(b => b.innerText)"""
        )
        reasons = {label.split("\n")[0]: label.split("\n")[1:] for label in labels}
        assert reasons.keys() >= {"Pause", "Skip trial", "End session", "You have control"}
        assert all(len(why) == 1 and why[0] and not why[0].startswith("key ") for why in reasons.values()), reasons

    settles(each_says_why)


def test_question_mark_shows_every_key_and_hides_them_again(tab: Any, source: Stage) -> None:
    for typed in ("?", "Shift+?"):
        tab.keyboard.press(typed)
        tab.wait_for_selector("#op-keys.on")
        shown = tab.inner_text("#op-keys")
        assert all(key.cap in shown and key.does in shown for key in keys_of(Page.CONSOLE))
        button(tab, "STOP").click()
        assert wait_until(lambda: len(source.stops) >= 1), "STOP is above the list"
        button(tab, "Keys").click()
        tab.wait_for_selector("#op-keys:not(.on)", state="attached")


def test_a_second_browser_only_looks_until_it_takes_control(tab: Any, browser: Any, source: Stage) -> None:
    other = browser.new_page(viewport={"width": 1024, "height": 768})
    other.goto(tab.url)
    other.wait_for_selector("#op-state[data-state='RUNNING']", timeout=30_000)
    other.wait_for_selector("button:has-text('Take control')")
    assert button(other, "Pause").is_disabled() and "take control first" in button(other, "Pause").inner_text()
    other.keyboard.press("p")
    button(other, "Take control").click()
    other.wait_for_selector("button:has-text('You have control')")
    tab.wait_for_selector("button:has-text('Take control')")
    assert heard(source) == []
    button(other, "Pause").click()
    assert wait_until(lambda: heard(source) == [Intent.PAUSE])
    tab.wait_for_selector("button:has-text('Pause'):disabled")
    button(tab, "STOP").click()
    assert wait_until(lambda: len(source.stops) == 1), "STOP is everyone's"
    button(tab, "Take control").click()
    tab.wait_for_selector("button:has-text('You have control')")
    other.close()


def test_after_a_stop_resume_takes_a_click_not_a_stray_key(tab: Any, source: Stage) -> None:
    source.telemetry = stopped()
    tab.wait_for_selector("#op-state[data-state='STOPPED']")
    tab.wait_for_selector("button:has-text('Resume'):not(:disabled)")
    tab.keyboard.press("r")
    tab.wait_for_selector("#op-loop:has-text('click it')")
    assert heard(source) == []
    source.telemetry = replace(running(), state=State.PAUSED, allowed=(Intent.RESUME,))
    tab.wait_for_selector("#op-state[data-state='PAUSED']")
    tab.wait_for_selector("button:has-text('key R'):not(:disabled)")
    tab.keyboard.press("r")
    assert wait_until(lambda: heard(source) == [Intent.RESUME])


def test_the_overlay_rises_when_the_ui_process_dies_and_falls_when_it_returns(
    browser: Any, stage: Stage, start_page: Start
) -> None:
    process = start_page()
    page = browser.new_page(viewport={"width": 1280, "height": 720})
    page.goto(process.url)
    page.wait_for_selector("#op-state[data-state='RUNNING']", timeout=30_000)
    opacity = "getComputedStyle(document.querySelector('#op-dead')).opacity"
    page.wait_for_timeout(3000)
    assert page.evaluate(opacity) == "0"
    process.kill()
    page.wait_for_function(f"() => {opacity} === '1'")
    assert "NO LIVE DATA" in page.inner_text("#op-dead")
    stage.telemetry = running(5, 4)
    start_page()
    page.wait_for_selector("#op-state[data-attempt='4']", timeout=30_000)
    page.wait_for_function(f"() => {opacity} === '0'")
    page.close()


def test_the_overlay_names_a_silent_app(tab: Any, source: Stage) -> None:
    source.telemetry = None
    tab.wait_for_selector("#op-state[data-state='APP SILENT']")
    tab.wait_for_selector("#op-dead.now:has-text('APP SILENT')")
    assert button(tab, "Pause").is_disabled()
    button(tab, "STOP").click()
    assert wait_until(lambda: len(source.stops) == 1)


def test_flagged_chunks_are_shaded_in_the_value_plot(tab: Any, source: Stage) -> None:
    source.telemetry = adapting()
    tab.wait_for_selector("#op-state[data-state='LEARNING']")
    script = """() => Object.values(window.__viserTestpoints.uplots).map(u =>
        ({data: u.chart.data.map(a => Array.from(a)), x: [u.chart.scales.x.min, u.chart.scales.x.max],
          y: [u.chart.scales.y.min, u.chart.scales.y.max]}))"""
    tab.wait_for_function("() => Object.values(window.__viserTestpoints.uplots).some(u => u.chart.data[1][90] === 1)")
    value, change = tab.evaluate(script)
    flagged = adapting().flagged
    shaded = [tick for tick, on in enumerate(value["data"][1]) if on]
    assert shaded[0] == flagged[0]
    assert shaded[-1] == flagged[-1] + adapting().chunk_horizon
    for plot in (value, change):
        assert plot["x"] == [0, 150]
        assert plot["y"][0] < plot["y"][1]


def test_live_pictures_reach_the_page(tab: Any) -> None:
    script = """async () => { const image = [...document.querySelectorAll('img')].find(i => i.naturalWidth === 320);
        if (!image) return null; const first = image.src; await new Promise(r => setTimeout(r, 1000));
        const now = [...document.querySelectorAll('img')].find(i => i.naturalWidth === 320);
        return now ? now.src !== first : null; }"""
    assert wait_until(lambda: tab.evaluate(script) is True)


def test_the_page_asks_nothing_of_the_outside(tab: Any) -> None:
    outside = [u for u in tab.requests if not u.startswith(("http://127.0.0.1:", "data:", "blob:"))]
    assert outside == []


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (1920, 1080), (1024, 768), (1600, 1200), (768, 1024)])
def test_nothing_is_clipped_or_covered(tab: Any, source: Stage, width: int, height: int) -> None:
    source.telemetry = adapting()
    tab.set_viewport_size({"width": width, "height": height})
    tab.wait_for_selector("#op-state[data-state='LEARNING']")

    def all_within_and_apart() -> None:
        boxes = tab.evaluate(
            """() => { const cells = ['#op-state', '#op-stop', '#op-adapt', '#op-history', '#op-events', '#op-loop']
                .map(s => document.querySelector(s).parentElement)
                .concat([...document.querySelectorAll('button.mantine-Button-root')].map(b => b.parentElement)
                    .filter(e => e.getBoundingClientRect().width > 0 && getComputedStyle(e).visibility === 'visible'))
                .concat([...document.querySelectorAll('.uplot-container')]);
              return cells.map(e => { const r = e.getBoundingClientRect();
                return [r.left, r.top, r.right, r.bottom, (e.innerText || '').slice(0, 20)]; }); }"""
        )
        for left, top, right, bottom, text in boxes:
            assert -1 <= left < right <= width + 1, text
            assert -1 <= top < bottom <= height + 1, text
        for i, a in enumerate(boxes):
            for b in boxes[i + 1 :]:
                across = min(a[2], b[2]) - max(a[0], b[0])
                down = min(a[3], b[3]) - max(a[1], b[1])
                assert across <= 1 or down <= 1, (a[4], b[4])

    settles(all_within_and_apart)


def test_a_second_browser_that_comes_late_sees_everything(tab: Any, browser: Any, source: Stage) -> None:
    source.telemetry = adapting()
    tab.wait_for_selector("#op-state[data-state='LEARNING']")
    late = browser.new_page(viewport={"width": 1280, "height": 720})
    late.goto(tab.url)
    late.wait_for_selector("#op-state[data-state='LEARNING']", timeout=30_000)
    assert "6 of 10" in late.inner_text("#op-adapt")
    late.close()
    source.mode = RobotMode.HOMING
    tab.wait_for_selector("#op-state:has-text('arm goes home')")


def test_trouble_with_a_camera_stands_above_its_picture(tab: Any, source: Stage) -> None:
    source.cameras = {"front": CameraHealth(frames=900, dropped=12, stale=3, age=0.02)}
    tab.wait_for_selector(".mark-front.tone-idle em:has-text('12 dropped · 3 stale')")
    source.cameras = {"front": CameraHealth(frames=900, frozen=30, age=0.8)}
    tab.wait_for_selector(".mark-front.tone-warn em:has-text('picture 0.8 s old · 30 frozen')")
    assert tab.inner_text(".mark-wrist em") == ""
    source.cameras = {}
    tab.wait_for_selector(".mark-front.tone-idle")
