"""The ui process: python -m ui.server --run-folder DIR [--host 127.0.0.1] [--port 8080].

Reads telemetry and views, shows them, sends intents; may die and come back at any time. One thread does everything but
STOP (its own line) and viser's event loop. Exits 0 on SIGTERM or SIGINT, and when its parent dies.
"""

from __future__ import annotations

import argparse
import gc
import logging
import queue
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from far_app.endpoints import Endpoints
from far_app.lineage import VersionWish
from far_app.marks import MarkAttempt
from far_app.parent import die_with_parent, run_until_told
from far_app.recording.said_lines import now
from far_app.session_states import Intent
from far_app.signal_event import SignalSafeEvent
from far_app.take_over import Nudge
from far_app.telemetry import Telemetry
from ui.access import Access
from ui.console import Console
from ui.feeds import Feeds
from ui.live_viewer import LiveViewer
from ui.live_why import LiveWhy
from ui.page_server import open_page
from ui.presence import Presence
from ui.stop import StopLine, hasten
from ui.view_model import Freshness

log = logging.getLogger(__name__)

TICK = 1 / 10
"""Seconds between two looks at the sockets; pictures and poses are pushed at this rate, in one window, so that a
browser without a graphics card draws once for both."""


@dataclass
class Every:
    """True once a period; keeps its mean rate even where it is asked at a rate that is no multiple."""

    period: float
    due: float = 0.0

    def __call__(self, now: float) -> bool:
        if now < self.due:
            return False
        on_time = self.due + self.period > now
        self.due = self.due + self.period if on_time else now + self.period
        return True


@dataclass(frozen=True, kw_only=True)
class PageOptions:
    run_folder: Path
    host: str = "127.0.0.1"
    token: Path | None = None
    """File of what a browser must show to open the page; needed on any address but loopback."""
    port: int = 8080
    scene3d: bool = True
    operator: str = "operator"
    cameras: Sequence[str] = ("front", "wrist")
    """Views whose pictures are shown; the first two fit."""
    rerun: bool = True
    """Show the session live in rerun too, in a process of its own."""
    recordings: Path = Path("recordings")
    """Where the sessions lie whose closed attempts rerun shows."""


class Page:
    """Feeds, console and STOP line of one ui process."""

    def __init__(self, options: PageOptions) -> None:
        self._options = options
        endpoints = Endpoints.in_folder(options.run_folder)
        access = Access.at(options.host, options.token)
        self._presence = Presence()
        self._beside: dict[str, LiveViewer | LiveWhy] = {}
        self._server = open_page(access, options.port, self._presence, self._door)
        self.url = access.url(self._server.get_port())
        listener = self._server._websock_server._server_thread
        if listener is not None and listener.native_id is not None:
            hasten(listener.native_id)  # the thread that hears STOP
        self._feeds = Feeds(endpoints)
        self._stop_line = StopLine(endpoints)
        self._console = Console(
            self._server, self._stop_line, self._presence, self._latest, scene3d=options.scene3d,
            cameras=options.cameras,
        )  # fmt: skip
        at = ["--host", options.host, *(("--token", str(options.token)) if options.token is not None else ())]
        self._viewer = LiveViewer(options.run_folder, options.recordings, at) if options.rerun else None
        self._why = LiveWhy(options.run_folder, options.recordings, options.operator, at)
        self._beside |= {"why": self._why, **({"rerun": self._viewer} if self._viewer is not None else {})}
        self._plots, self._texts, self._trails, self._beats = Every(1 / 5), Every(1 / 5), Every(1 / 5), Every(1 / 2)
        self._telling = Every(1 / 4)
        self._hw_seq = 0

    def _door(self, name: str) -> str | None:
        """Where the page's links lead; asked from the first moment on."""
        beside = self._beside.get(name)
        return beside.url if beside is not None else None

    def _latest(self) -> tuple[Telemetry | None, Freshness]:
        return self._feeds.telemetry.message, self._fresh()

    def _fresh(self) -> Freshness:
        return Freshness(app=self._feeds.telemetry.age(), hw=self._feeds.view.age())

    def tick(self) -> None:
        """One look at the sockets; whatever is due is sent to the browsers in one window."""
        now = time.monotonic()
        heard = self._feeds.telemetry.poll()
        telemetry, fresh = self._latest()
        if self._telling(now):
            self._feeds.present(self._presence.count())
        with self._server.atomic():
            self._show_view()
            if self._beats(now):
                self._console.beat(fresh)
            if self._texts(now):
                viewer = self._viewer.url if self._viewer is not None else None
                self._console.text(telemetry, self._feeds.view.message, fresh, viewer, self._why.url)
            if telemetry is not None and heard:
                self._why.follow(telemetry)
                if self._plots(now):
                    self._console.plots.show(telemetry)
                if self._console.scene is not None:
                    self._console.scene.chunk(telemetry)
                    self._console.scene.follow(telemetry)
                    if self._trails(now):
                        self._console.scene.trail(telemetry)

    def _show_view(self) -> None:
        scene = self._console.scene
        if scene is not None:
            geometry = self._feeds.geometry.poll()
            if geometry is not None:
                scene.build(geometry)
        if not self._feeds.view.poll():
            return
        view = self._feeds.view.message
        if view.seq < self._hw_seq:
            self._feeds.geometry.again()
        self._hw_seq = view.seq
        if scene is not None:
            scene.pose(view.body_poses)
        self._console.pictures(view)

    def rest(self, until: float) -> None:
        """Wait for the next tick (monotonic seconds); what is pressed meanwhile goes to the app at once."""
        while True:
            try:
                said = self._console.pressed.get(timeout=max(0.0, until - time.monotonic()))
            except queue.Empty:
                return
            said = signed(said, self._options.operator)
            if not self._feeds.send(said, self._options.operator) and said is not Intent.STOP:
                what = said.value if isinstance(said, Intent) else type(said).__name__
                log.warning("nobody takes the word %s: is the app running?", what)
                self._console.refuse(what, "the app did not take it; press again")

    def close(self) -> None:
        self._why.close()
        if self._viewer is not None:
            self._viewer.close()
        self._stop_line.close()
        self._feeds.close()
        self._server.stop()


def signed(said: Any, by: str) -> Any:
    """A word with who said it and when, where it carries that."""
    if isinstance(said, MarkAttempt):
        return replace(said, mark=replace(said.mark, by=by, wall=now()))
    return replace(said, by=by) if isinstance(said, Nudge | VersionWish) else said


def serve(options: PageOptions, ended: SignalSafeEvent) -> None:
    """Run the page until `ended` is set or our parent is gone."""
    orphaned = die_with_parent()
    page = Page(options)
    log.info("the operator page is at %s", page.url)
    gc.freeze()
    try:
        due = time.monotonic()
        while not ended.is_set() and not orphaned():
            page.tick()
            due = max(due + TICK, time.monotonic())
            page.rest(due)
    finally:
        page.close()


def parse(arguments: Sequence[str] | None) -> PageOptions:
    parser = argparse.ArgumentParser(prog="python -m ui.server", description="The operator page of one run.")
    parser.add_argument("--run-folder", type=Path, required=True, help="folder with the run's sockets")
    parser.add_argument("--host", default="127.0.0.1", help="address to bind; any but loopback needs --token")
    parser.add_argument("--token", type=Path, default=None, help="file of the token, made where it is missing")
    parser.add_argument("--port", type=int, default=8080, help="0 lets the system choose")
    parser.add_argument("--operator", default="operator", help="name stored with every intent")
    parser.add_argument("--cameras", nargs="*", default=("front", "wrist"), help="views to show, the first two of them")
    parser.add_argument("--recordings", type=Path, default=Path("recordings"), help="folder of the sessions")
    parser.add_argument("--no-rerun", dest="rerun", action="store_false", help="no live rerun viewer")
    parser.add_argument("--no-scene3d", dest="scene3d", action="store_false", help="leave out the twin's meshes")
    return PageOptions(**vars(parser.parse_args(arguments)))


def main(arguments: Sequence[str] | None = None) -> int:
    return run_until_told(parse, serve, arguments)


if __name__ == "__main__":
    sys.exit(main())
