"""`far replay` on the sample session in a real headless Chromium: stepping, what-if, correcting, adapting again."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ui_process import free_port, wait_until

from far_app.marks import Verdict
from far_app.recording.reader import read_session
from ui.keys import Page, keys_of

sync_api = pytest.importorskip("playwright.sync_api", reason="pip install playwright (the dev extra)")
CHROMIUM = Path("/usr/bin/chromium")
ROOT = Path(__file__).resolve().parents[2]
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader"]
ARGUMENTS += ["--enable-unsafe-swiftshader"]
FLAGGED = (20, 21, 35, 36, 37, 38, 39, 43, 44, 45, 46, 47, 48, 49, 50)
SETTLED = 60_000

pytestmark = [
    pytest.mark.page,
    pytest.mark.slow,
    pytest.mark.skipif(not CHROMIUM.exists(), reason="no /usr/bin/chromium: apt-get install chromium"),
]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(ROOT / "recordings/sample", tmp_path_factory.mktemp("replay") / "session"))


@pytest.fixture(scope="module")
def page(session: Path) -> Iterator[Any]:
    port = free_port()
    code = "import sys; from far_app.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "replay", str(session), "--port", str(port), "--operator", "ada"]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and str(port) in process.stdout.readline()
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=str(CHROMIUM), args=ARGUMENTS)
        tab = chromium.new_page(viewport={"width": 1280, "height": 720})
        tab.requests = []
        tab.on("request", lambda request: tab.requests.append(request.url))
        tab.goto(f"http://127.0.0.1:{port}")
        tab.wait_for_selector("#why-state[data-outcome='FAILURE'][data-tick='50']", timeout=SETTLED)
        yield tab
        assert all(url.startswith((f"http://127.0.0.1:{port}", "data:", "blob:")) for url in tab.requests)
        chromium.close()
    process.terminate()
    assert process.wait(timeout=20) == 0
    process.stdout.close()


def at(page: Any, tick: int) -> None:
    page.wait_for_selector(f"#why-state[data-tick='{tick}']", timeout=SETTLED)


def test_stepping_shows_each_flagged_chunk_with_frames_at_its_start_and_end(page: Any) -> None:
    for tick in FLAGGED[:3]:
        page.keyboard.press("n")
        at(page, tick)
        page.wait_for_selector(f"#why-frames figure[data-camera='front'][data-tick='{tick}'] img")
        page.wait_for_selector(f"#why-frames figure[data-camera='wrist'][data-tick='{tick + 8}'] img")
        assert f"Chunk {tick} – {tick + 7}" in page.inner_text("#why-numbers")
        assert page.get_attribute("#why-numbers", "data-flagged") == "1"
    page.get_by_role("button", name="◀ Flagged").click()
    at(page, FLAGGED[1])
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowLeft")
    at(page, FLAGGED[1] - 2)
    assert page.get_attribute("#why-numbers", "data-flagged") == "0"
    page.keyboard.press("n")
    at(page, FLAGGED[0])


def click_chart(page: Any, chart: str, tick: int, last: int = 150) -> None:
    box = page.locator(chart).bounding_box()
    page.mouse.click(box["x"] + box["width"] * (44 + 346 * tick / last) / 400, box["y"] + box["height"] / 2)


def test_a_click_in_either_chart_selects_the_chunk_that_begins_there(page: Any) -> None:
    for chart, tick in (("#why-v", 100), ("#why-dv", 20), ("#why-v", 0), ("#why-dv", 50)):
        click_chart(page, chart, tick)
        at(page, tick)
    page.set_viewport_size({"width": 768, "height": 1024})
    page.wait_for_timeout(1000)
    click_chart(page, "#why-dv", 100)
    at(page, 100)
    page.set_viewport_size({"width": 1280, "height": 720})
    page.wait_for_timeout(1000)
    click_chart(page, "#why-v", 50)
    at(page, 50)


def test_the_better_chunks_are_drawn_and_ranked_by_q(page: Any) -> None:
    page.wait_for_selector("#why-numbers tr.sent", timeout=SETTLED)
    gains = [float(cell) for cell in page.locator("#why-numbers tr:not(.sent) td:nth-child(3)").all_inner_texts()]
    assert 1 <= len(gains) <= 8 and gains == sorted(gains, reverse=True)


def test_another_rho_changes_the_flagged_set_at_once_and_as_recorded_takes_it_back(page: Any) -> None:
    box = page.locator(".slot-rho").locator("xpath=../following-sibling::div[1]").locator("input:visible").last
    box.fill("20")
    box.press("Enter")
    page.wait_for_selector("#why-state[data-flagged='29']", timeout=SETTLED)
    assert "what if: ρ 20 %" in page.inner_text("#why-state")
    page.get_by_role("button", name="As recorded").click()
    page.wait_for_selector("#why-state[data-flagged='15']", timeout=SETTLED)


def test_another_horizon_is_a_what_if_and_a_key_takes_it_back(page: Any) -> None:
    box = page.locator(".slot-horizon").locator("xpath=../following-sibling::div[1]").locator("input:visible").last
    box.fill("16")
    box.press("Enter")
    page.wait_for_selector("#why-numbers:has-text('Chunk 50 – 65')", timeout=SETTLED)
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("r")
    page.wait_for_selector("#why-numbers:has-text('Chunk 50 – 57')", timeout=SETTLED)


def test_arrows_go_through_the_attempts_and_the_ends_are_dead_and_say_so(page: Any) -> None:
    page.keyboard.press("ArrowDown")
    page.wait_for_selector("#why-state[data-outcome='SUCCESS'][data-attempt='1']", timeout=SETTLED)
    last = page.locator("button:has-text('Attempt ▶'):disabled:has-text('the last')")
    last.wait_for(timeout=SETTLED)
    page.keyboard.press("ArrowDown")
    page.get_by_role("button", name="◀ Attempt").click()
    at(page, 50)
    assert page.get_attribute("#why-state", "data-attempt") == "0"


def test_question_mark_lists_this_pages_keys(page: Any) -> None:
    page.keyboard.press("?")
    page.wait_for_selector("#op-keys.on:has-text('adapt again')", timeout=SETTLED)
    assert len(page.locator("#op-keys kbd").all()) == len(keys_of(Page.WHY))
    page.keyboard.press("?")
    page.wait_for_selector("#op-keys:not(.on)", state="attached", timeout=SETTLED)


def test_the_operators_word_is_kept_beside_the_recording(page: Any, session: Path) -> None:
    page.evaluate("document.activeElement.blur()")
    tick = int(page.get_attribute("#why-state", "data-tick"))
    page.keyboard.press("f")
    page.wait_for_selector("#why-state[data-flagged='14']", timeout=SETTLED)
    assert "by ada" in page.inner_text("#why-numbers")
    lines = (session / "corrections.jsonl").read_text().splitlines()
    assert json.loads(lines[-1])["detail"] == {
        "trial": 1, "attempt": 1, "tick": tick, "flagged": False, "by": "ada", "used": False,
    }  # fmt: skip
    page.get_by_role("button", name="Flag to blame").click()
    page.wait_for_selector("#why-state[data-flagged='15']", timeout=SETTLED)
    assert wait_until(lambda: len((session / "corrections.jsonl").read_text().splitlines()) == 2)


def test_an_attempt_is_marked_by_key_and_click_beside_the_programs_judgment(page: Any, session: Path) -> None:
    page.click("#far-tab-marks summary")
    assert "program: failure (horizon)" in page.inner_text("#why-marks")
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("y")
    page.wait_for_selector("#why-state[data-outcome='UNSURE']", timeout=SETTLED)
    page.locator("div:has(> .mark-note) + div input").click()
    page.keyboard.type("look at it again")
    page.locator("button:has-text('Keep note'):not(:disabled)").click()
    page.wait_for_selector("#why-marks:has-text('ada: look at it again')", timeout=SETTLED)
    page.wait_for_function("() => document.querySelector('div:has(> .mark-note) + div input').value === ''")
    page.get_by_role("button", name="Failure").click()
    page.wait_for_selector("#why-state[data-outcome='FAILURE']", timeout=SETTLED)
    assert "program: failure (horizon)" in page.inner_text("#why-marks")
    words = read_session(session).words
    assert [(w.verdict, w.note, w.by) for w in words] == [
        (Verdict.UNSURE, "", "ada"), (None, "look at it again", "ada"), (Verdict.FAILURE, "", "ada"),
    ]  # fmt: skip
    assert all(w.wall for w in words)
    page.click("#far-tab-marks summary")


def test_adapting_again_shows_both_losses_and_what_moved(page: Any) -> None:
    page.keyboard.press("g")
    page.wait_for_selector("#why-lesson[data-steps='11'][data-stage='']", timeout=2 * SETTLED)
    assert "l⁺" in page.inner_text("#why-lesson") and "mm" in page.inner_text("#why-lesson")
