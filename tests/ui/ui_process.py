"""The real ui process, as the app starts it, for tests."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path


class PageProcess:
    """python -m ui.server, as the app starts it."""

    def __init__(self, folder: Path, port: int, *arguments: str, scene3d: bool = False) -> None:
        self.url = f"http://127.0.0.1:{port}"
        command = [sys.executable, "-m", "ui.server", "--run-folder", str(folder), "--port", str(port)]
        command += ["--no-rerun", *arguments, *([] if scene3d else ["--no-scene3d"])]
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


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_until(condition: Callable[[], bool], seconds: float = 10.0) -> bool:
    """Poll until it holds."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.02)
    return condition()


def settles(check: Callable[[], None], seconds: float = 15.0) -> None:
    """A check of what a page shows passes in the end: labels and layout come in several messages."""

    def passes() -> bool:
        try:
            check()
        except AssertionError:
            return False
        return True

    if not wait_until(passes, seconds):
        check()
