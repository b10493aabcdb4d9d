"""`far replay PATH`: a recorded session or attempt in the rerun viewer."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="far replay", description="A recorded session in the rerun viewer.")
    parser.add_argument("path", type=Path, nargs="?", default=Path("recordings"), help="session, attempt or .rrd file")
    parser.add_argument("--web", action="store_true", help="in a browser page instead of a window")
    parser.add_argument("--port", type=int, default=9090, help="the page's port")
    options = parser.parse_args(list(arguments))

    from far_app.recording.replay import replay
    from ui.rerun_views import attempt_to_rrd

    def announce(url: str) -> None:
        print(f"The rerun viewer is at {url} (Ctrl-C ends it)", flush=True)

    replay(options.path, attempt_to_rrd, web=options.web, port=options.port, announce=announce)
    return 0
