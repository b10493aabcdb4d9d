"""Several viewers, one who holds control: the server enforces it, everybody is told, STOP is everyone's."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from ui_process import PageProcess, wait_until
from ui_stage import Stage

from far_app.session_states import Intent
from ui.presence import Viewer
from ui.raw_client import RawClient
from ui.viewers import seat

Start = Callable[..., PageProcess]
LABELS = ("Pause", "Mark success", "Mark failure", "Skip trial", "End session")


def opened(page: PageProcess) -> RawClient:
    client = RawClient(page.url)
    assert client.read(20, lambda: has(client, "You have control") or has(client, "Take control\nviewer"))
    return client


def has(client: RawClient, label: str) -> bool:
    return client.find(label) is not None


def press(client: RawClient, label: str) -> None:
    uuid = client.find(label)
    assert uuid is not None, label
    client.press(uuid)


def dead(client: RawClient, label: str) -> bool:
    uuid = client.find(label)
    assert uuid is not None, label
    return bool(client.widgets[uuid]["disabled"])


@pytest.fixture
def page(start_page: Start, stage: Stage) -> PageProcess:
    return start_page()


def test_the_first_holds_control_and_the_next_only_looks(page: PageProcess, stage: Stage) -> None:
    first, second = opened(page), opened(page)
    assert second.read(5, lambda: has(second, "Take control\nviewer 1 has it"))
    assert first.read(5, lambda: has(first, "You have control\n1 more watching"))
    assert first.read(5, lambda: not any(dead(first, label) for label in LABELS))
    assert second.read(5, lambda: all(dead(second, label) for label in LABELS))
    assert second.html("op-state"), "and sees everything"


def test_a_press_without_control_is_refused_by_the_server_and_stop_is_not(page: PageProcess, stage: Stage) -> None:
    first, second = opened(page), opened(page)
    for label in LABELS:
        press(second, label)
    assert first.read(5, lambda: "viewer 1 holds control" in first.html("op-loop"))
    press(second, "STOP")
    assert wait_until(lambda: len(stage.stops) == 1)
    assert {i.intent for i in stage.intents} <= {Intent.STOP}


def test_control_is_taken_over_on_request(page: PageProcess, stage: Stage) -> None:
    first, second = opened(page), opened(page)
    press(second, "Take control")
    assert second.read(5, lambda: has(second, "You have control") and not dead(second, "Pause"))
    assert first.read(5, lambda: has(first, "Take control\nviewer 2 has it") and dead(first, "Pause"))
    press(first, "Pause")
    press(second, "Mark failure")
    assert wait_until(lambda: [i.intent for i in stage.intents] == [Intent.MARK_FAILURE])


def test_a_reload_keeps_control_and_a_viewer_does_not_get_it_unasked(page: PageProcess, stage: Stage) -> None:
    first, second = opened(page), opened(page)
    first.close()
    assert second.read(5, lambda: has(second, "Take control\nnobody has it"))
    assert wait_until(lambda: stage.present[-1].clients == 0), "nobody who could act looks"
    again = opened(page)
    assert again.read(5, lambda: has(again, "You have control"))
    assert wait_until(lambda: stage.present[-1].clients == 1)


def test_each_viewer_has_the_list_of_keys_for_itself(page: PageProcess, stage: Stage) -> None:
    first, second = opened(page), opened(page)
    press(second, "Keys")
    assert second.read(5, lambda: "skip the trial" in second.html("op-keys"))
    first.read(1.0)
    assert "skip the trial" not in first.html("op-keys")
    press(second, "Keys")
    assert second.read(5, lambda: "skip the trial" not in second.html("op-keys"))


def test_a_holder_that_does_not_answer_is_said_to() -> None:
    gone, me = Viewer(name="viewer 1", holds=True, answers=False), Viewer(name="viewer 2", holds=False, answers=True)
    assert seat(me, gone, 2) == ("Take control", "viewer 1 does not answer", True)
