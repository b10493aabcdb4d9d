"""Attempts' files to .rrd files, and the rerun viewer on them: `far replay PATH`.

The drawing itself (blueprint, entities) is the operator interface's: whoever composes the program hands it in as
`write_rrd(recording, path)`.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import signal
import socket
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

from far_app.errors import ConfigError, RecordingError
from far_app.recording.attempt_reader import AttemptRecording, read_attempt
from far_app.recording.inspect import find_session
from far_app.recording.reader import read_session
from far_app.recording.scan import ends_in_order

log = logging.getLogger(__name__)

WriteRrd = Callable[[AttemptRecording, Path], None]
"""Writes one attempt as one .rrd with its blueprint; needs no display."""

LOOPBACK = "127.0.0.1"


def replay(
    path: Path,
    write_rrd: WriteRrd,
    *,
    web: bool = False,
    port: int = 9090,
    announce: Callable[[str], None] = lambda url: None,
) -> None:
    """`far replay PATH`: a session, one attempt of it, a folder of sessions (the newest) or an .rrd, in the viewer.
    The .rrd files are made first, so that they are there even where no viewer can open. Raises FarError."""
    rrds = [path] if path.suffix == ".rrd" else make_rrds(path, write_rrd)
    open_viewer(rrds, web=web, port=port, announce=announce)


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


def open_viewer(
    rrds: Sequence[Path], *, web: bool = False, port: int = 9090, announce: Callable[[str], None] = lambda url: None
) -> None:
    """Shows the files in the rerun viewer, in a window, or on a page at `port` of the loopback address whose URL goes
    to `announce`. Blocks until the viewer is closed (Ctrl-C and SIGTERM close it). Raises ConfigError when no viewer
    can open."""
    _check_display(web, rrds)
    if web:
        _check_port(port)
    data_port = _free_port()
    with quiet_configuration() as environment, _interrupted_by_sigterm():
        viewer = subprocess.Popen(viewer_command(rrds, data_port, web_port=port if web else None), env=environment)
        try:
            if web:
                announce(viewer_url(port, data_port))
            status = viewer.wait()
        except KeyboardInterrupt:
            status = 0
        finally:
            viewer.terminate()
            viewer.wait()
    if status:
        raise ConfigError(
            f"the rerun viewer ended with status {status}; "
            + (f"is port {port} free?" if web else "if this machine has no graphics, add --web")
        )


def viewer_command(rrds: Sequence[Path], data_port: int, web_port: int | None) -> list[str]:
    """The viewer's command line, bound to the loopback address; with a window when web_port is None."""
    command = [str(_viewer_binary()), *map(str, rrds), "--bind", LOOPBACK, "--port", str(data_port)]
    return command if web_port is None else [*command, "--serve-web", "--web-viewer-port", str(web_port)]


def viewer_url(port: int, data_port: int) -> str:
    """The page, told where its data is."""
    return f"http://{LOOPBACK}:{port}/?url={quote(f'rerun+http://{LOOPBACK}:{data_port}/proxy', safe='')}"


def _viewer_binary() -> Path:
    package = importlib.util.find_spec("rerun_cli")
    binary = Path(package.origin).parent / "rerun" if package is not None and package.origin else Path("rerun")
    if not binary.exists():
        raise ConfigError("the rerun viewer is not installed; run: pip install rerun-sdk")
    return binary


@contextmanager
def _interrupted_by_sigterm() -> Iterator[None]:
    """SIGTERM ends the wait as Ctrl-C does, so that no viewer is left behind."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _check_display(web: bool, rrds: Sequence[Path]) -> None:
    if web or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return
    where = rrds[0].parent if len(rrds) == 1 else os.path.commonpath(rrds)
    raise ConfigError(
        "no viewer can open here: this machine has no display (DISPLAY and WAYLAND_DISPLAY are unset); add --web "
        f"to see it in a browser, or copy the .rrd files from {where} to a machine that has one"
    )


def _check_port(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            raise ConfigError(f"port {port} cannot be used: {error.strerror}; choose another with --port") from error


@contextmanager
def quiet_configuration() -> Iterator[dict[str, str]]:
    """An environment in which the viewer sends no usage data; the user's own settings stay as they are."""
    with tempfile.TemporaryDirectory(prefix="far_viewer_") as folder:
        environment = {**os.environ, "XDG_CONFIG_HOME": folder}
        disable = [str(_viewer_binary()), "analytics", "disable"]
        subprocess.run(disable, env=environment, capture_output=True, check=False, timeout=30)
        yield environment


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]


def _up_to_date(attempt: Path) -> bool:
    rrd = rrd_path(attempt)
    return rrd.exists() and rrd.stat().st_mtime_ns >= attempt.stat().st_mtime_ns
