"""`far replay PATH`: why did it fail. A recorded session in the attempt view; with --rerun in the rerun viewer."""

from __future__ import annotations

import argparse
import contextlib
import getpass
import signal
from collections.abc import Iterator, Sequence
from pathlib import Path

from far_app.signal_event import SignalSafeEvent


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="far replay",
        description="Why an attempt failed: cameras, V and value change, flagged and better chunks. Needs no robot.",
    )
    parser.add_argument("path", type=Path, nargs="?", default=Path("recordings"), help="session, attempt or .rrd file")
    parser.add_argument("--policy", type=Path, help="the policy's checkpoint where it is not where the session says")
    parser.add_argument("--critic", type=Path, action="append", default=[], help="a critic to ask; may be repeated")
    parser.add_argument("--operator", default=getpass.getuser(), help="name stored with corrections")
    parser.add_argument("--rerun", action="store_true", help="in the rerun viewer instead")
    parser.add_argument("--web", action="store_true", help="with --rerun: in a browser page instead of a window")
    parser.add_argument("--port", type=int, default=9090, help="the page's port; 0 lets the system choose")
    parser.add_argument("--no-scene3d", dest="scene3d", action="store_false", help="leave out the 3D view")
    options = parser.parse_args(list(arguments))
    if options.rerun or options.web or options.path.suffix == ".rrd":
        return _rerun(options)
    return _attempt_view(options)


def _rerun(options: argparse.Namespace) -> int:
    from far_app.recording.replay import replay
    from ui.rerun_views import attempt_to_rrd

    def announce(url: str) -> None:
        print(f"The rerun viewer is at {url} (Ctrl-C ends it)", flush=True)

    replay(options.path, attempt_to_rrd, web=options.web, port=options.port, announce=announce)
    return 0


def _attempt_view(options: argparse.Namespace) -> int:
    """The page in its own process, the answers in this one. Raises FarError."""
    from far_app.cli.processes import Child, run_folder
    from far_app.cli.replay_desk import Desk, loader
    from far_app.recording.inspect import find_session
    from far_app.recording.reader import read_session

    attempt = options.path if options.path.suffix == ".mcap" else None
    folder = attempt.parent.parent if attempt is not None else find_session(options.path)
    session = read_session(folder)
    critics, load = loader(session, options.policy, options.critic)
    page = ["--session", str(folder), "--port", str(options.port), "--operator", options.operator]
    page += ["--attempt", str(attempt)] if attempt is not None else []
    page += [] if options.scene3d else ["--no-scene3d"]
    with run_folder() as sockets, _interrupts() as ended:
        desk = Desk(sockets, session, critics, load)
        child = Child("page", "ui.why", ["--run-folder", str(sockets), *page], sockets)
        told = False

        def over() -> bool:
            nonlocal told
            child.check()
            url = "" if told else _served(child.log_path)
            if url:
                told = True
                print(f"The attempt view is at {url} (Ctrl-C ends it)", flush=True)
            return ended.is_set()

        try:
            desk.serve(over)
        finally:
            child.end()
            desk.close()
    return 0


def _served(log: Path) -> str:
    """The page's address, once it says so."""
    words = log.read_text(errors="replace").split("the attempt view is at ")
    return words[1].split()[0] if len(words) > 1 and "\n" in words[1] else ""


@contextlib.contextmanager
def _interrupts() -> Iterator[SignalSafeEvent]:
    """Ctrl-C and SIGTERM end it in order."""
    before = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield SignalSafeEvent().set_on(*before)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
