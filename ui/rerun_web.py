"""rerun's web viewer, served by ourselves: loopback only, and sealed so that the browser asks nothing of the outside.

`rerun --serve-web` can bind loopback, but its page loads fonts, a script and usage counters from the internet. So it is
started once, its five files are taken from it, and we serve them under a Content-Security-Policy that leaves one place
to connect to: the data server of this run.
"""

from __future__ import annotations

import http.server
import re
import shutil
import subprocess
import threading
import time
import urllib.error
import urllib.request
from functools import partial
from pathlib import Path
from typing import Any

from far_app.errors import FarError
from far_app.recording.replay import LOOPBACK, quiet_configuration, viewer_command
from ui.parent import killed_with_parent

FILES = ("index.html", "re_viewer.js", "re_viewer_bg.wasm", "favicon.ico", "sw.js")
PATIENCE = 60.0
"""Seconds given to the viewer's own server to appear."""
_OUTSIDE = re.compile(r"<link\b[^>]*https://[^>]*>|<script\b[^>]*src=\"https://[^>]*>\s*</script>", re.DOTALL)


def policy(data_port: int) -> str:
    """What the viewer's page may load and talk to."""
    return (
        "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob:; "
        f"style-src 'self' 'unsafe-inline'; connect-src 'self' data: blob: http://{LOOPBACK}:{data_port}"
    )


def take_viewer(folder: Path, port: int, data_port: int) -> None:
    """Copies the viewer's files from the rerun program into a folder. Raises FarError when it does not start."""
    with quiet_configuration() as environment:
        program = subprocess.Popen(
            viewer_command([], data_port, web_port=port), env=environment, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL, preexec_fn=killed_with_parent,  # noqa: PLW1509 (only prctl runs there)
        )  # fmt: skip
        try:
            _wait_for(f"http://{LOOPBACK}:{port}/index.html", program)
            for name in FILES:
                with (
                    urllib.request.urlopen(f"http://{LOOPBACK}:{port}/{name}", timeout=30) as source,
                    (folder / name).open("wb") as copy,
                ):
                    shutil.copyfileobj(source, copy)
        finally:
            program.kill()
            program.wait()
    page = folder / "index.html"
    page.write_text(_OUTSIDE.sub("", page.read_text(encoding="utf-8")), encoding="utf-8")


def _wait_for(url: str, program: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + PATIENCE
    while True:
        try:
            urllib.request.urlopen(url, timeout=5).close()
            return
        except (urllib.error.URLError, OSError) as error:
            if program.poll() is not None or time.monotonic() > end:
                raise FarError(f"the rerun viewer does not answer at {url}: {error}; run with --no-rerun") from error
            time.sleep(0.1)


class SealedViewer:
    """Serves the folder on loopback from a thread until closed."""

    def __init__(self, folder: Path, port: int, data_port: int) -> None:
        handler = partial(_Handler, directory=str(folder), policy=policy(data_port))
        self._server = http.server.ThreadingHTTPServer((LOOPBACK, port), handler)
        self._server.daemon_threads = True
        self.port = int(self._server.server_address[1])
        threading.Thread(target=self._server.serve_forever, name="rerun-web", daemon=True).start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


class _Handler(http.server.SimpleHTTPRequestHandler):
    def __init__(self, *arguments: Any, directory: str, policy: str) -> None:
        self._policy = policy
        super().__init__(*arguments, directory=directory)

    def end_headers(self) -> None:
        self.send_header("Content-Security-Policy", self._policy)
        self.send_header("Referrer-Policy", "no-referrer")
        super().end_headers()

    def list_directory(self, path: Any) -> None:
        self.send_error(404)

    def log_message(self, format: str, *args: object) -> None:
        """Nothing: one line a request is too much."""
