"""The run's other processes: started together, watched, ended together. No orphan, whatever ends us.

A child ends by itself when we die, even by SIGKILL (each asks Linux for SIGTERM at its parent's death, and looks at its
parent's id). It stands in a process group of its own, so that Ctrl-C reaches us alone and we end the children in order.
Starting one uses vfork: a restart does not stall the loop.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from far_app.errors import FarError

log = logging.getLogger(__name__)


class ProcessError(FarError):
    """A process of the run did not start or ended by itself."""


@contextlib.contextmanager
def run_folder() -> Iterator[Path]:
    """A private folder with a short path for the run's sockets and its processes' logs; gone at the end."""
    folder = Path(tempfile.mkdtemp(prefix="far-"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


class Child:
    """One process of the run: `python -m module …`."""

    def __init__(self, name: str, module: str, arguments: Sequence[str], folder: Path, patience: float = 5.0) -> None:
        """`patience`: seconds it is given to end by itself once told to."""
        self.name, self._command, self._patience = name, [sys.executable, "-m", module, *arguments], patience
        self.log_path = folder / f"{name}.log"
        self.starts = 0
        self._process: subprocess.Popen[bytes]
        self.start()

    def start(self) -> None:
        """Start it, or start it again."""
        self.starts += 1
        with self.log_path.open("ab") as output:
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, process_group=0
            )
        log.info("%s: process %d", self.name, self._process.pid)

    @property
    def pid(self) -> int:
        return self._process.pid

    def alive(self) -> bool:
        return self._process.poll() is None

    def last_words(self) -> str:
        """Its last line of output that tells of an error, else its last line."""
        try:
            lines = self.log_path.read_text(errors="replace").strip().splitlines()
        except OSError:
            return ""
        last = next((line for line in reversed(lines) if "Error" in line or " ERROR " in line), (lines or [""])[-1])
        if last.startswith("{"):
            with contextlib.suppress(ValueError):
                return str(json.loads(last).get("error", last))
        return last

    def check(self, before: str = "") -> None:
        """Raise ProcessError when it has ended; `before` is what is known besides."""
        code = self._process.poll()
        if code is not None:
            words = self.last_words() or "it said nothing"
            raise ProcessError(f"{before}the {self.name} process ended with status {code}: {words}")

    def end(self) -> None:
        """SIGTERM, then SIGKILL when patience is over; a stopped (frozen) process is woken to hear it."""
        if not self.alive():
            return
        with contextlib.suppress(ProcessLookupError):
            self._process.terminate()
            self._process.send_signal(signal.SIGCONT)
        try:
            self._process.wait(self._patience)
        except subprocess.TimeoutExpired:
            log.warning("%s did not end within %.0f s; killed", self.name, self._patience)
            self._process.kill()
            self._process.wait()
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)  # what it may have started itself


class Family:
    """The children of one run; the one that may die (the page) is started again."""

    def __init__(self) -> None:
        self.children: list[Child] = []
        self._restarts: dict[str, float] = {}

    def add(self, child: Child) -> Child:
        self.children.append(child)
        return child

    def revive(self, child: Child, every: float = 2.0) -> bool:
        """Start a dead child again, at most once per `every` seconds; True when it was."""
        now = time.monotonic()
        if child.alive() or now - self._restarts.get(child.name, 0.0) < every:
            return False
        self._restarts[child.name] = now
        log.warning("%s ended (%s); starting it again", child.name, child.last_words())
        child.start()
        return True

    def end(self) -> None:
        for child in reversed(self.children):
            child.end()
