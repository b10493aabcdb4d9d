"""The attempt view's process: python -m ui.why --session DIR --run-folder DIR [--attempt FILE] [--port 8081].

Reads the recording itself (frames, V, flags: numpy only) and asks the app for what needs torch. The same for a session
that runs and for one that is over; may die and come back at any time. Exits 0 on SIGTERM or SIGINT, and when its parent
dies. Prints {"url": …} once it serves.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from far_app.parent import die_with_parent, run_until_told
from far_app.signal_event import SignalSafeEvent
from ui.why_view import View, WhyOptions

log = logging.getLogger(__name__)


def serve(options: WhyOptions, ended: SignalSafeEvent) -> None:
    os.nice(5)  # beside a live run it gives way to the loop, the learning and the operator's page
    orphaned = die_with_parent()
    view = View(options)
    log.info("the attempt view is at %s", view.url)
    print(json.dumps({"url": view.url}), flush=True)
    try:
        while not ended.is_set() and not orphaned():
            view.turn()
    finally:
        view.close()


def parse(arguments: Sequence[str] | None) -> WhyOptions:
    parser = argparse.ArgumentParser(prog="python -m ui.why", description="Why an attempt failed, chunk by chunk.")
    parser.add_argument("--session", type=Path, required=True, help="the session's folder")
    parser.add_argument("--run-folder", type=Path, required=True, help="folder with the sockets of the app or replay")
    parser.add_argument("--attempt", type=Path, default=None, help="the attempt's file to open first")
    parser.add_argument("--host", default="127.0.0.1", help="address to bind; any but loopback needs --token")
    parser.add_argument("--token", type=Path, default=None, help="file of the token, made where it is missing")
    parser.add_argument("--port", type=int, default=8081, help="0 lets the system choose")
    parser.add_argument("--operator", default="operator", help="name stored with every correction")
    parser.add_argument("--no-scene3d", dest="scene3d", action="store_false", help="leave out the 3D view")
    return WhyOptions(**vars(parser.parse_args(arguments)))


def main(arguments: Sequence[str] | None = None) -> int:
    return run_until_told(parse, serve, arguments)


if __name__ == "__main__":
    sys.exit(main())
