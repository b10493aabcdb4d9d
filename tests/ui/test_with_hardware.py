"""The real ui process against the real hw server: geometry and pictures come, STOP latches the real controller."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from ui_process import PageProcess

from ui.raw_client import RawClient

pytestmark = pytest.mark.slow
Start = Callable[..., PageProcess]


@pytest.fixture
def hardware(folder: Path) -> Iterator[None]:
    command = [sys.executable, "-m", "hw.server", "--folder", str(folder)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert process.stdout is not None
    said = json.loads(process.stdout.readline())
    if "error" in said:
        process.wait()
        pytest.fail(f"the hw server did not start: {said['error']}")
    yield
    process.terminate()
    process.wait(timeout=20)
    process.stdout.close()


def test_stop_on_the_page_latches_the_real_hw_server(start_page: Start, hardware: None) -> None:
    """No app runs at all: neither the latch nor its confirmation needs one."""
    client = RawClient(start_page().url)
    assert client.read(30, lambda: "arm holds" in client.html("op-state"))
    stop = client.find("STOP")
    assert stop is not None
    client.press(stop)
    assert client.read(10, lambda: "latched in" in client.html("op-stop"))
    assert client.read(10, lambda: "arm latched" in client.html("op-state"))


def test_the_twin_s_meshes_and_pictures_reach_a_client(folder: Path, port: int, hardware: None) -> None:
    page = PageProcess(folder, port, scene3d=True)
    try:
        client = RawClient(page.url)
        assert client.read(30, lambda: len(client.nodes) > 20)
        pictures = [props for props in client.widgets.values() if props.get("type") == "GuiImageMessage"]
        assert client.read(30, lambda: sum(len(p["_data"] or b"") > 2000 for p in pictures) == 2), "one a camera"
    finally:
        page.kill()
