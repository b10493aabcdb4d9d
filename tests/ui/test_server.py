"""The ui process: one address or none, own Origins, refused presses, STOP without the app, orderly ends."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from ui_process import PageProcess, wait_until
from ui_stage import Stage, running, stopped
from websockets.exceptions import ConnectionClosed, InvalidStatus

from far_app.endpoints import Endpoints
from far_app.session_states import Intent
from far_app.types import RobotMode
from ui.raw_client import RawClient
from ui.stop import StopLine

Start = Callable[..., PageProcess]


def connected(page: PageProcess) -> RawClient:
    client = RawClient(page.url)
    assert client.read(10, lambda: 'data-state="RUNNING"' in client.html("op-state"))
    return client


def test_a_taken_port_is_an_error_that_names_it(folder: Path, port: int) -> None:
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", port))
        holder.listen()
        command = [sys.executable, "-m", "ui.server", "--run-folder", str(folder), "--port", str(port)]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 2
    assert f"port {port}" in ended.stderr
    assert "--port" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_foreign_origins_are_refused_and_our_own_are_not(start_page: Start, stage: Stage) -> None:
    page = start_page()
    own = page.url.rsplit(":", 1)[1]
    for origin in ("http://evil.example", f"http://evil.example:{own}", "http://127.0.0.1:1", "null"):
        with pytest.raises(InvalidStatus):
            RawClient(page.url, origin=origin)
    for origin in (page.url, f"http://localhost:{own}", None):
        RawClient(page.url, origin=origin).close()


def test_stop_reaches_the_hw_server_though_the_app_is_silent(start_page: Start, stage: Stage) -> None:
    client = connected(start_page())
    stage.telemetry = None
    stop = client.find("STOP")
    assert stop is not None
    client.press(stop)
    assert wait_until(lambda: len(stage.stops) == 1)
    assert stage.stops[0].source == "page: button"
    assert client.read(10, lambda: "latched in" in client.html("op-stop"))


def test_an_unanswered_stop_is_said_to_be_unconfirmed(start_page: Start, stage: Stage) -> None:
    client = connected(start_page())
    stage.close()
    stop = client.find("STOP")
    assert stop is not None
    client.press(stop)
    assert client.read(15, lambda: "NOT CONFIRMED" in client.html("op-stop"))


def test_an_allowed_press_reaches_the_app_and_a_disabled_one_is_refused(start_page: Start, stage: Stage) -> None:
    client = connected(start_page())
    resume, pause = client.find("Resume"), client.find("Pause")
    assert resume is not None
    assert pause is not None
    assert client.widgets[resume]["disabled"]
    client.press(resume)
    assert client.read(10, lambda: "resume refused: nothing is held" in client.html("op-loop"))
    client.press(pause)
    assert wait_until(lambda: [i.intent for i in stage.intents] == [Intent.PAUSE])


def test_a_press_that_raced_a_stop_is_refused(start_page: Start, stage: Stage) -> None:
    """The button was live when pressed on the page, but the state had moved on."""
    client = connected(start_page())
    stage.telemetry = stopped()
    assert client.read(10, lambda: 'data-state="STOPPED"' in client.html("op-state"))
    success = client.find("Mark success")
    assert success is not None
    client.press(success)
    assert client.read(10, lambda: "refused: Resume first" in client.html("op-loop"))
    assert stage.intents == []


def test_hostile_messages_change_nothing(start_page: Start, stage: Stage) -> None:
    page = start_page()
    client = connected(page)
    stop = client.find("STOP")
    assert stop is not None
    client.send({"type": "GuiUpdateMessage", "uuid": stop, "updates": {"update_cb": [], "value": True}})
    client.send({"type": "GuiUpdateMessage", "uuid": stop, "updates": {"removed": True}})
    client.send({"type": "GuiUpdateMessage", "uuid": "no such thing", "updates": {"value": True}})
    client.send({"type": "ShareUrlRequest"})
    client.read(1.0)
    for message in ({"type": "NoSuchMessage"}, {"no": "type"}, {"type": "GuiUpdateMessage", "uuid": 1}):
        other = RawClient(page.url)
        other.send(message)
        with pytest.raises(ConnectionClosed):
            other.read(10)
    assert stage.stops == []
    client.press(stop)
    assert wait_until(lambda: len(stage.stops) == 1)


def test_the_page_comes_back_after_sigkill_with_everything_in_it(start_page: Start, stage: Stage) -> None:
    first = start_page()
    connected(first)
    first.kill()
    stage.telemetry = replace(running(), attempt=3)
    client = connected(start_page())
    assert client.read(10, lambda: 'data-attempt="3"' in client.html("op-state"))
    assert client.read(10, lambda: "not solved" in client.html("op-history"))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_with_zero(start_page: Start, number: signal.Signals) -> None:
    page = start_page()
    page.process.send_signal(number)
    assert page.process.wait(timeout=10) == 0


def test_it_goes_with_its_parent(folder: Path, port: int) -> None:
    arguments = ["-m", "ui.server", "--run-folder", str(folder), "--port", str(port), "--no-scene3d", "--no-rerun"]
    code = (
        "import subprocess, sys, time\n"
        f"child = subprocess.Popen([sys.executable, *{arguments!r}])\n"
        "print(child.pid, flush=True)\ntime.sleep(600)"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())

    def listening() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    assert wait_until(listening, 30)
    parent.kill()
    parent.wait()
    parent.stdout.close()
    assert wait_until(lambda: gone(child))


def gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").split(")")[1].split()[0] == "Z"
    except (ProcessLookupError, FileNotFoundError):
        return True


def test_the_stop_line_gives_up_and_works_again(folder: Path) -> None:
    """A REQ that timed out is never reused: the next press works once the hw server is there."""
    line = StopLine(Endpoints.in_folder(folder))
    line.press("test")
    assert wait_until(lambda: line.result is not None and line.result.latched is False)
    stage = Stage(folder)
    line.press("test")
    assert wait_until(lambda: line.result is not None and line.result.latched is True)
    assert stage.mode is RobotMode.LATCHED
    line.close()
    stage.close()


def test_a_press_does_not_wait_for_the_hw_server(folder: Path) -> None:
    stage = Stage(folder)
    stage.stop_answers = False
    line = StopLine(Endpoints.in_folder(folder))
    line.press("test")
    assert line.result is None or line.result.latched is None
    assert wait_until(lambda: len(stage.stops) == 1)
    line.close()
    stage.close()


def test_a_frozen_browser_does_not_count_as_somebody_who_looks(start_page: Start, stage: Stage) -> None:
    page = start_page()
    look = f"from ui.raw_client import RawClient; c = RawClient({page.url!r}); c.read(60)"
    browser = subprocess.Popen([sys.executable, "-c", look])
    try:
        assert wait_until(lambda: bool(stage.present) and stage.present[-1].clients == 1)
        browser.send_signal(signal.SIGSTOP)
        frozen = time.monotonic()
        assert wait_until(lambda: stage.present[-1].clients == 0, 5.0)
        assert time.monotonic() - frozen < 2.5
        browser.send_signal(signal.SIGCONT)
        assert wait_until(lambda: stage.present[-1].clients == 1, 5.0), "and counts again when it is awake"
    finally:
        browser.kill()
        browser.wait()
