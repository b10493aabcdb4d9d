"""The attempt view beside a live page: a process of its own, started at the session's first failure, linked to."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from far_app.recording.schema import SESSION_FILE
from far_app.telemetry import Telemetry


class LiveWhy:
    """`python -m ui.why`; url is None until it serves and again when it is gone."""

    def __init__(self, run_folder: Path, recordings: Path, operator: str, at: Sequence[str]) -> None:
        """`at`: the page's own --host and --token."""
        self._run_folder, self._recordings, self._operator, self._at = run_folder, recordings, operator, at
        self._process: subprocess.Popen[str] | None = None
        self.url: str | None = None

    def follow(self, telemetry: Telemetry) -> None:
        """Start it once something was flagged."""
        session = self._recordings / telemetry.session
        if self._process is not None or not telemetry.flagged or not (session / SESSION_FILE).exists():
            return
        command = [sys.executable, "-m", "ui.why", "--session", str(session), "--run-folder", str(self._run_folder)]
        command += ["--port", "0", "--operator", self._operator, *self._at]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        threading.Thread(target=self._listen, args=(self._process,), name="why", daemon=True).start()

    def _listen(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            try:
                self.url = str(json.loads(line)["url"])
            except (ValueError, KeyError, TypeError):
                continue
        self.url = None

    def close(self) -> None:
        process = self._process
        if process is None or process.poll() is not None:
            return
        process.terminate()
        try:
            process.wait(timeout=1)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
