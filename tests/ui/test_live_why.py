"""The attempt view beside a live page: started at the first failure, linked to, what is said there goes to the app."""

from __future__ import annotations

import http.client
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

from ui_process import PageProcess, wait_until
from ui_stage import Stage, adapting, running

from far_app.marks import MarkAttempt, Verdict
from far_app.what_if import CorrectFlag
from ui.raw_client import RawClient

SAMPLE = Path(__file__).resolve().parents[2] / "recordings/sample"


def door(page: PageProcess) -> str:
    """Where the page's link to the attempt view leads; "" while it leads nowhere."""
    at = urlsplit(page.url)
    connection = http.client.HTTPConnection(at.netloc, timeout=5)
    connection.request("GET", "/go/why")
    answer = connection.getresponse()
    connection.close()
    return answer.getheader("Location") or ""


def live(view: RawClient, label: str) -> bool:
    """There is such a button, and it can be pressed."""
    button = view.find(label)
    return button is not None and not view.widgets[button].get("disabled")


def test_at_the_first_failure_it_opens_and_its_words_go_to_the_running_app(
    start_page: Callable[..., PageProcess], stage: Stage, tmp_path: Path
) -> None:
    session = Path(shutil.copytree(SAMPLE, tmp_path / "r" / running().session))
    page = start_page("--recordings", str(session.parent), "--operator", "ada")
    assert not door(page), "nothing has failed yet"
    stage.telemetry = replace(adapting(), session=session.name)
    assert wait_until(lambda: bool(door(page)), 30)
    view = RawClient(door(page))
    assert view.read(20, lambda: 'data-outcome="FAILURE"' in view.html("why-state")), "at the newest failure"
    for label in ("Unflag", "Unsure"):
        assert view.read(10, lambda label=label: live(view, label)), label
        view.press(view.find(label) or "")
    assert wait_until(lambda: len(stage.words) == 2)
    correction, marked = stage.words
    name = "2026-11-22_21-31-09_lift_far"
    assert isinstance(correction, CorrectFlag) and correction.session == name
    assert (correction.correction.tick, correction.correction.flagged, correction.correction.by) == (50, False, "ada")
    assert isinstance(marked, MarkAttempt) and marked.session == name
    assert (marked.mark.trial, marked.mark.attempt, marked.mark.verdict) == (1, 1, Verdict.UNSURE)
    assert marked.mark.by == "ada" and marked.mark.wall
    adapt = view.find("Adapt again")
    assert adapt is not None and view.widgets[adapt]["label"].endswith("only in far replay")
    view.close()
    before = {file for file in session.rglob("*") if file.is_file()}
    assert before == {session / file.relative_to(SAMPLE) for file in SAMPLE.rglob("*") if file.is_file()}
