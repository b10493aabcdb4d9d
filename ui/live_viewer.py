"""The rerun process beside the page: started, linked to once it is ready, ended. The page works without it."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

log = logging.getLogger(__name__)


class LiveViewer:
    """`python -m ui.rerun_live`; url is None until it serves and again when it is gone."""

    def __init__(self, run_folder: Path, recordings: Path, at: Sequence[str]) -> None:
        """`at`: the page's own --host and --token."""
        command = [sys.executable, "-m", "ui.rerun_live", "--run-folder", str(run_folder)]
        self._process = subprocess.Popen(
            [*command, "--recordings", str(recordings), *at], stdout=subprocess.PIPE, text=True
        )
        self._url: str | None = None
        threading.Thread(target=self._listen, name="rerun-live", daemon=True).start()

    @property
    def url(self) -> str | None:
        return self._url

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            try:
                self._url = str(json.loads(line)["viewer"])
            except (ValueError, KeyError, TypeError):
                continue
            log.info("the rerun viewer is at %s", self._url)
        self._url = None
        log.info("the rerun process ended with status %d", self._process.wait())

    def close(self) -> None:
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(timeout=1)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
