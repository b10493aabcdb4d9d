"""rerun's web viewer, served by ourselves: bound and guarded as the page is, and sealed so that the browser asks
nothing of the outside.

`rerun --serve-web` can bind loopback, but its page loads fonts, a script and usage counters from the internet. So it is
started once, its five files are taken from it, and we serve them under a Content-Security-Policy that leaves one place
to connect to: here. The data server knows no token and stays on loopback; what the viewer asks of it is handed on.
"""

from __future__ import annotations

import contextlib
import http.client
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
from urllib.parse import quote

from far_app.errors import FarError
from far_app.parent import killed_with_parent
from far_app.recording.replay import LOOPBACK, quiet_configuration, viewer_command
from ui.access import Access

FILES = ("index.html", "re_viewer.js", "re_viewer_bg.wasm", "favicon.ico", "sw.js")
PATIENCE = 60.0
"""Seconds given to the viewer's own server to appear."""
_OUTSIDE = re.compile(r"<link\b[^>]*https://[^>]*>|<script\b[^>]*src=\"https://[^>]*>\s*</script>", re.DOTALL)


POLICY = (
    "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; connect-src 'self' data: blob:"
)
"""What the viewer's page may load and talk to."""
ASKED = re.compile(r"/[A-Za-z0-9_.]+/[A-Za-z]+")
"""Path of a call to the data server: /service/method."""
LARGEST = 2**20
"""Bytes of a call at most; the viewer's are a few hundred."""


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
    """Serves the folder from a thread until closed."""

    def __init__(self, folder: Path, access: Access, port: int, data_port: int) -> None:
        listener = access.listen(port)
        port = int(listener.getsockname()[1])
        handler = partial(_Handler, directory=str(folder), access=access, port=port, data_port=data_port)
        self._server = _Server((access.address, port), handler, bind_and_activate=False)
        self._server.socket.close()
        self._server.socket = listener
        base = f"http://{access.name}:{port}"
        data = quote(f"rerun+{base}/proxy", safe="")
        self.url = f"{base}/?{f'token={access.token}&' if access.token else ''}url={data}"
        threading.Thread(target=self._server.serve_forever, name="rerun-web", daemon=True).start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


class _Server(http.server.ThreadingHTTPServer):
    daemon_threads = True


class _Handler(http.server.SimpleHTTPRequestHandler):
    def __init__(self, *arguments: Any, directory: str, access: Access, port: int, data_port: int) -> None:
        self._access, self._port, self._data_port = access, port, data_port
        super().__init__(*arguments, directory=directory)

    def parse_request(self) -> bool:
        """Whoever may not come gets no further."""
        if not super().parse_request():
            return False
        headers = {name.title(): value for name, value in self.headers.items()}
        said = self._access.answer(self.path, headers, self._port)
        if said is None:
            return True
        status, words, headers = said
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(words.encode())
        return False

    def do_POST(self) -> None:
        """A call of the viewer to the data server, its answer passed on as it comes."""
        size = int(self.headers.get("Content-Length") or 0)
        if not ASKED.fullmatch(self.path) or not 0 <= size <= LARGEST:
            self.send_error(404)
            return
        kept = ("content-type", "accept", "x-grpc-web", "x-user-agent", "grpc-timeout")
        headers = {
            name: value for name, value in self.headers.items() if name.lower() in kept or name.startswith("x-rerun")
        }
        data = http.client.HTTPConnection(LOOPBACK, self._data_port)
        with contextlib.closing(data), contextlib.suppress(OSError, http.client.HTTPException):
            data.request("POST", self.path, self.rfile.read(size), headers)
            answer = data.getresponse()
            self.send_response(answer.status)
            for name, value in answer.getheaders():
                if name.lower() in ("content-type", "grpc-status", "grpc-message"):
                    self.send_header(name, value)
            self.end_headers()
            while part := answer.read1(65536):
                self.wfile.write(part)

    def end_headers(self) -> None:
        self.send_header("Content-Security-Policy", POLICY)
        self.send_header("Referrer-Policy", "no-referrer")
        super().end_headers()

    def list_directory(self, path: Any) -> None:
        self.send_error(404)

    def log_message(self, format: str, *args: object) -> None:
        """Nothing: one line a request is too much."""
