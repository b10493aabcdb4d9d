"""Stepping in, in a real headless Chromium: every new control by click and by key, live only where it can act."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from test_page import ARGUMENTS, CHROMIUM, button
from test_panels import ATTEMPTS, ROWS
from ui_process import PageProcess, free_port, settles, wait_until
from ui_stage import Stage, running

from far_app.lineage import Versions, VersionWish, Wish
from far_app.marks import Verdict
from far_app.session_states import Intent, State, allowed
from far_app.take_over import Move, Steering
from far_app.types import RobotMode
from ui.keys import Page, key_of
from ui.take_over import _PAD

sync_api = pytest.importorskip("playwright.sync_api", reason="pip install playwright (the dev extra)")
pytestmark = [
    pytest.mark.page,
    pytest.mark.skipif(not CHROMIUM.exists(), reason="no /usr/bin/chromium: apt-get install chromium"),
]
TAKEN = replace(
    running(), state=State.TAKEN_OVER, allowed=allowed(State.TAKEN_OVER), steering=Steering(source="page"),
    attempts=ATTEMPTS, versions=Versions(rows=ROWS, acting="3:base+a1", undo="1:base+a1"),
)  # fmt: skip


@pytest.fixture(scope="module")
def opened() -> Iterator[tuple[Any, Stage]]:
    with TemporaryDirectory(prefix="far") as name, sync_api.sync_playwright() as playwright:
        source = Stage(Path(name))
        process = PageProcess(Path(name), free_port())
        chromium = playwright.chromium.launch(executable_path=str(CHROMIUM), args=ARGUMENTS)
        page = chromium.new_page(viewport={"width": 1280, "height": 720})
        page.goto(process.url)
        page.wait_for_selector("#op-state[data-state='RUNNING']", timeout=60_000)
        yield page, source
        chromium.close()
        process.kill()
        source.close()


@pytest.fixture
def tab(opened: tuple[Any, Stage]) -> Any:
    """Taken over, every panel closed."""
    page, source = opened
    source.telemetry = TAKEN
    page.wait_for_selector("#op-state[data-state='TAKEN OVER']")
    page.evaluate("document.activeElement.blur(); document.querySelectorAll('details').forEach(d => d.open = false)")
    source.intents.clear()
    source.words.clear()
    return page


@pytest.fixture
def source(opened: tuple[Any, Stage]) -> Stage:
    return opened[1]


def live(tab: Any, label: str) -> Any:
    """A button, once it can be pressed."""
    tab.wait_for_function(
        "label => [...document.querySelectorAll('button.mantine-Button-root')].some(b => !b.disabled && "
        "b.innerText.startsWith(label) && b.getBoundingClientRect().width > 0)", arg=label,
    )  # fmt: skip
    return tab.get_by_role("button", name=re.compile(f"^{re.escape(label)}( |$)"))


def test_the_panel_opens_by_itself_and_every_move_goes_by_click_and_by_key(tab: Any, source: Stage) -> None:
    assert tab.locator("#op-steer").is_visible()
    caps = {"arrowup": "ArrowUp", "arrowdown": "ArrowDown", "arrowleft": "ArrowLeft", "arrowright": "ArrowRight"}
    for move, label, _, _ in _PAD:
        source.words.clear()
        live(tab, label).click()
        assert wait_until(lambda: len(source.words) == 1), label
        key = key_of(Page.CONSOLE, move)
        assert key is not None
        tab.keyboard.press(caps.get(key.hotkey, key.hotkey.lower()))
        assert wait_until(lambda: len(source.words) == 2), key
        assert [word.move for word in source.words] == [move, move]
        assert all(word.by for word in source.words)


def test_hand_back_stands_where_take_over_stood_and_each_has_its_key(tab: Any, source: Stage) -> None:
    live(tab, "Hand back").click()
    tab.keyboard.press("b")
    assert wait_until(lambda: [i.intent for i in source.intents] == [Intent.HAND_BACK] * 2)
    source.telemetry = replace(TAKEN, state=State.RUNNING, allowed=allowed(State.RUNNING))
    tab.wait_for_selector("#op-state[data-state='RUNNING']")
    live(tab, "Take over").click()
    tab.keyboard.press("t")
    assert wait_until(lambda: [i.intent for i in source.intents][2:] == [Intent.TAKE_OVER] * 2)
    assert button(tab, "Hand back").count() == 0


def test_moves_are_dead_and_say_why_while_the_policy_has_the_arm_and_the_server_refuses_them(
    tab: Any, source: Stage
) -> None:
    source.telemetry = replace(TAKEN, state=State.RUNNING, allowed=allowed(State.RUNNING))
    tab.wait_for_selector("#op-state[data-state='RUNNING']")
    assert not tab.locator("#op-steer").is_visible()
    tab.click("#far-tab-steer summary")
    tab.wait_for_function(
        "() => [...document.querySelectorAll('button')].some(b => b.disabled && b.innerText.startsWith('Forward') && "
        "b.innerText.includes('take over first'))"
    )
    tab.keyboard.press("ArrowUp")
    tab.evaluate(
        "() => { const b = [...document.querySelectorAll('button')].find(b => b.innerText.startsWith('Forward'));"
        " b.disabled = false; b.click(); }"
    )
    tab.keyboard.press("u")
    assert source.words == []


def test_space_stops_while_a_person_steers(tab: Any, source: Stage) -> None:
    source.stops.clear()
    live(tab, "Forward").click()
    tab.keyboard.press("Space")
    assert wait_until(lambda: len(source.stops) == 1)
    assert wait_until(lambda: [word.move for word in source.words] == [Move.FORWARD]), "and presses no focused button"


def test_marks_of_an_earlier_attempt_and_a_note_carry_who_and_when(tab: Any, source: Stage) -> None:
    tab.click("#far-tab-marks summary")
    assert tab.locator("#op-marks").is_visible() and not tab.locator("#op-steer").is_visible()
    tab.keyboard.press("y")
    assert wait_until(lambda: len(source.words) == 1)
    assert (source.words[0].mark.attempt, source.words[0].mark.verdict) == (TAKEN.attempt, Verdict.UNSURE)
    live(tab, "Earlier").click()
    tab.wait_for_selector("#op-marks:has-text('Trial 2, attempt 1')")
    live(tab, "Failure").click()
    assert wait_until(lambda: len(source.words) == 2)
    field = tab.locator("input[type=text], textarea, input:not([type])").last
    field.fill("fell down afterwards")
    live(tab, "Keep note").click()
    assert wait_until(lambda: len(source.words) == 3)
    failure, note = (word.mark for word in source.words[1:])
    assert (failure.trial, failure.attempt, failure.verdict) == (2, 1, Verdict.FAILURE)
    assert (note.trial, note.verdict, note.note) == (2, None, "fell down afterwards")
    assert all(word.mark.by and word.mark.wall for word in source.words)
    live(tab, "Later").click()


def test_a_space_in_a_note_is_written_and_stops_nothing_and_stop_is_a_click_away(tab: Any, source: Stage) -> None:
    source.stops.clear()
    source.mode = RobotMode.TRACKING
    tab.wait_for_selector("#op-stop:has-text('space key')")
    tab.click("#far-tab-marks summary")
    field = tab.locator("div:has(> .mark-note) + div input")
    said = "getComputedStyle(document.querySelector('#op-stop'), '::after').content"
    assert tab.evaluate(said) == "none"
    field.click()
    assert "click STOP" in tab.evaluate(said), "the hint that names the space key gives way"
    tab.keyboard.type("it fell ")
    button(tab, "STOP").click()
    assert wait_until(lambda: [stop.source for stop in source.stops] == ["page: button"]), "the spaces pressed nothing"
    assert field.input_value() == "it fell "
    live(tab, "Keep note").click()
    assert wait_until(lambda: [word.mark.note for word in source.words] == ["it fell"])
    tab.wait_for_function("() => document.querySelector('div:has(> .mark-note) + div input').value === ''")
    tab.evaluate("document.activeElement.blur()")
    tab.keyboard.press("Space")
    assert wait_until(lambda: len(source.stops) == 2), "outside the field it is STOP again"


def test_versions_are_undone_restored_and_kept(tab: Any, source: Stage) -> None:
    tab.keyboard.press("z")
    assert wait_until(lambda: source.words == [VersionWish(wish=Wish.UNDO, by="operator")])
    tab.click("#far-tab-versions summary")
    assert "3:base+a1 ← 1:base+a1 ← base" in tab.inner_text("#op-versions")
    live(tab, "Older").click()
    live(tab, "Act with it next").click()
    live(tab, "Begin trials with it").click()
    assert wait_until(lambda: len(source.words) == 3)
    assert [(word.wish, word.version) for word in source.words[1:]] == [
        (Wish.RESTORE, "1:base+a1"), (Wish.KEEP, "1:base+a1"),
    ]  # fmt: skip


def test_a_demonstration_that_waits_opens_its_panel(tab: Any, source: Stage) -> None:
    source.telemetry = replace(
        TAKEN, state=State.REVIEWING, allowed=allowed(State.REVIEWING), reason="success, 4.8 s (1 of 3 kept): keep it?"
    )
    tab.wait_for_selector("#op-state[data-state='KEEP IT?']")
    assert "4.8 s" in tab.inner_text("#op-demo") and tab.locator("#op-demo").is_visible()
    live(tab, "Keep it").click()
    tab.keyboard.press("g")
    tab.keyboard.press("x")
    assert wait_until(lambda: [i.intent for i in source.intents] == [Intent.KEEP, Intent.RECORD_AGAIN, Intent.DISCARD])


@pytest.mark.parametrize("panel", ["steer", "marks", "versions"])
def test_nothing_within_a_panel_is_covered_or_outside_of_it(tab: Any, panel: str) -> None:
    tab.click(f"#far-tab-{panel} summary")

    def all_within_and_apart() -> None:
        frame, boxes = tab.evaluate(
            """name => {
              const r = e => { const b = e.getBoundingClientRect(); return [b.left, b.top, b.right, b.bottom]; };
              const card = document.querySelector(`#op-${name}`), [left, top, right, bottom] = r(card);
              const within = [...document.querySelectorAll('button.mantine-Button-root, .far-panel input')]
                .filter(e => e.getBoundingClientRect().width > 0)
                .concat([...card.querySelectorAll('p, table')])
                .map(r).filter(b => b[0] >= left - 1 && b[0] < right && b[1] >= top && b[1] < bottom);
              return [r(card), within]; }""", panel,
        )  # fmt: skip
        assert len(boxes) > 4
        for box in boxes:
            assert box[2] <= frame[2] + 1 and box[3] <= frame[3] + 1
        for i, a in enumerate(boxes):
            for b in boxes[i + 1 :]:
                assert min(a[2], b[2]) - max(a[0], b[0]) <= 1 or min(a[3], b[3]) - max(a[1], b[1]) <= 1, (a, b)

    settles(all_within_and_apart)
