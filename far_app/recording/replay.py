"""Attempts' files to .rrd files, and the rerun viewer on them: `far replay PATH`.

The drawing itself (blueprint, entities) is the operator interface's: whoever composes the program hands it in as
`write_rrd(recording, path)`.
"""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from far_app.errors import ConfigError, RecordingError
from far_app.recording.inspect import find_session
from far_app.recording.reader import AttemptRecording, read_attempt, read_session
from far_app.recording.scan import ends_in_order

log = logging.getLogger(__name__)

WriteRrd = Callable[[AttemptRecording, Path], None]
"""Writes one attempt as one .rrd with its blueprint; needs no display."""

LOOPBACK = "127.0.0.1"


def rrd_path(attempt: Path) -> Path:
    """Where an attempt's .rrd lies: beside its recording."""
    return attempt.with_suffix(".rrd")


def lacking_rrd(session: Path) -> list[Path]:
    """Closed attempts of a session without an up-to-date .rrd."""
    files = [file for file in read_session(session).files if ends_in_order(file)]
    return [file for file in files if not _up_to_date(file)]


def make_rrd(attempt: Path, write_rrd: WriteRrd, folder: Path | None = None) -> Path:
    """The attempt's .rrd, made when it is missing or older than the recording; whole or not at all. Another folder
    than the recording's may be named. Raises RecordingError."""
    path = rrd_path(attempt) if folder is None else folder / f"{attempt.parent.name}_{attempt.stem}.rrd"
    if folder is None and _up_to_date(attempt):
        return path
    half = path.with_name(f".{path.name}.partial")
    try:
        write_rrd(read_attempt(attempt), half)
        os.replace(half, path)
    except OSError as error:
        raise RecordingError(f"cannot write {path}: {error.strerror}; free some space") from error
    finally:
        half.unlink(missing_ok=True)
    return path


def make_rrds(path: Path, write_rrd: WriteRrd) -> list[Path]:
    """The .rrd files of a session (or of the one attempt `path` names); in a temporary folder where the recording's
    cannot be written."""
    attempts = [path] if path.suffix == ".mcap" else list(read_session(find_session(path)).files)
    if not attempts:
        raise RecordingError(f"{path} holds no attempts to show")
    writable = os.access(attempts[0].parent, os.W_OK)
    folder = None if writable else Path(tempfile.mkdtemp(prefix="far_rrd_"))
    made = []
    for attempt in attempts:
        try:
            made.append(make_rrd(attempt, write_rrd, folder))
        except RecordingError as error:
            log.warning("%s is not shown: %s", attempt, error)
    if not made:
        raise RecordingError(f"none of the {len(attempts)} attempts in {path} can be shown; try far inspect {path}")
    return made


def open_viewer(rrds: Sequence[Path], *, web: bool = False, port: int = 9090) -> int:
    """Shows the files in the rerun viewer, in a window or on a page at `port` of the loopback address; blocks until
    it is closed and returns its exit status. Raises ConfigError when no viewer can open."""
    _check_viewer(web, port, rrds)
    with _quiet_configuration() as environment:
        command = viewer_command(rrds, web=web, port=port)
        try:
            status = subprocess.run(command, env=environment, check=False).returncode
        except KeyboardInterrupt:
            return 0
    if status:
        raise ConfigError(
            f"the rerun viewer ended with status {status}; "
            + (f"is port {port} free?" if web else "if this machine has no graphics, add --web")
        )
    return status


def viewer_command(rrds: Sequence[Path], *, web: bool, port: int) -> list[str]:
    """The viewer's command line, bound to the loopback address."""
    command = [sys.executable, "-m", "rerun_cli", *map(str, rrds), "--bind", LOOPBACK, "--port", str(_free_port())]
    return [*command, "--serve-web", "--web-viewer-port", str(port)] if web else command


def viewer_url(port: int) -> str:
    return f"http://{LOOPBACK}:{port}"


def _check_viewer(web: bool, port: int, rrds: Sequence[Path]) -> None:
    if not web and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        where = rrds[0].parent if len(rrds) == 1 else os.path.commonpath(rrds)
        raise ConfigError(
            "no viewer can open here: this machine has no display (DISPLAY and WAYLAND_DISPLAY are unset); add --web "
            f"to see it in a browser, or copy the .rrd files from {where} to a machine that has one"
        )
    if web:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((LOOPBACK, port))
            except OSError as error:
                raise ConfigError(
                    f"port {port} cannot be used: {error.strerror}; choose another with --port"
                ) from error


@contextmanager
def _quiet_configuration() -> Iterator[dict[str, str]]:
    """An environment in which the viewer sends no usage data; the user's own settings stay as they are."""
    with tempfile.TemporaryDirectory(prefix="far_viewer_") as folder:
        environment = {**os.environ, "XDG_CONFIG_HOME": folder}
        disable = [sys.executable, "-m", "rerun_cli", "analytics", "disable"]
        subprocess.run(disable, env=environment, capture_output=True, check=False, timeout=30)
        yield environment


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]


def _up_to_date(attempt: Path) -> bool:
    rrd = rrd_path(attempt)
    return rrd.exists() and rrd.stat().st_mtime_ns >= attempt.stat().st_mtime_ns
