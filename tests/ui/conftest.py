"""The real ui process against a test source, for the tests that need both."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from ui_stage import Stage


class PageProcess:
    """python -m ui.server, as the app starts it."""

    def __init__(self, folder: Path, port: int, *arguments: str) -> None:
        self.url = f"http://127.0.0.1:{port}"
        command = [sys.executable, "-m", "ui.server", "--run-folder", str(folder), "--port", str(port)]
        command += ["--no-scene3d", "--no-rerun", *arguments]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline and self.process.poll() is None:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    return
            time.sleep(0.05)

    def end(self) -> int:
        """SIGTERM; the exit code."""
        self.process.terminate()
        return self.process.wait(timeout=10)

    def kill(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        if self.process.stderr is not None:
            self.process.stderr.close()


@pytest.fixture
def folder() -> Iterator[Path]:
    """Short enough for ipc socket names."""
    with TemporaryDirectory(prefix="far") as name:
        yield Path(name)


@pytest.fixture
def port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def stage(folder: Path) -> Iterator[Stage]:
    source = Stage(folder)
    yield source
    source.close()


@pytest.fixture
def start_page(folder: Path, port: int) -> Iterator[Callable[..., PageProcess]]:
    """Starts the ui process; called again it starts another on the same port."""
    started: list[PageProcess] = []

    def start(*arguments: str) -> PageProcess:
        started.append(PageProcess(folder, port, *arguments))
        return started[-1]

    yield start
    for page in started:
        page.kill()


def wait_until(condition: Callable[[], bool], seconds: float = 10.0) -> bool:
    """Poll until it holds."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.02)
    return condition()
