"""The processes beside the application: the hw server (unless another machine drives the arm), the page, and the one
that learns. How they are started, waited for, and the page revived.

Called by stage.py.
"""

from __future__ import annotations

import contextlib
import functools
import http.client
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from far_app.cli.agreement import agreed
from far_app.cli.options import RunOptions
from far_app.cli.processes import Child, Family
from far_app.endpoints import Endpoints, note_elsewhere
from far_app.errors import ArmTaken, FarError, RobotError
from far_app.link import RemoteRobot
from far_app.scheduling import nice
from far_app.station import station_at
from hw.rig import RigConfig

if TYPE_CHECKING:
    from far_app.learning.apart.protocol import Work

HARDWARE_PATIENCE = 180.0
"""Seconds for the hw server's first observation (a first start compiles for a while)."""
PAGE_PATIENCE = 60.0


def find_hardware(
    folder: Path, family: Family, options: RunOptions, rig: RigConfig
) -> tuple[Child | None, RigConfig]:  # fmt: skip
    """The hw server's process, or none where it runs on another machine and drives just this rig; and the rig with the
    arm's address. Raises ConfigError and RobotError."""
    if not options.hw:
        return family.add(start_hardware(folder, options.rig_file, options.task, options.host)), rig
    note_elsewhere(folder, options.hw, options.keys)
    station = station_at(Endpoints.in_folder(folder))
    rig = agreed(rig, options.task, station)
    options.refuse_unwatched(rig)
    return None, rig


def start_hardware(folder: Path, rig: str, task: str, address: str) -> Child:
    arguments = ["--folder", str(folder), "--rig", rig, "--task", task, "--parent", str(os.getpid())]
    arguments += ["--address", address] * bool(address)
    return Child("hardware", "hw.server", arguments, folder)


def start_page(folder: Path, options: RunOptions, port: int, cameras: Sequence[str]) -> Child:
    arguments = ["--run-folder", str(folder), "--host", options.page_host, "--port", str(port)]
    arguments += ["--token", str(options.page_token.absolute())] if options.page_token is not None else []
    arguments += ["--cameras", *cameras, "--recordings", str(options.recordings.absolute())]
    arguments += ["--operator", options.operator]
    arguments += ["--no-scene3d"] * (not options.scene3d) + ["--no-rerun"] * (not options.rerun)
    return Child("page", "ui.server", arguments, folder)


@contextlib.contextmanager
def learning(folder: Path, family: Family, options: RunOptions) -> Iterator[Callable[[], Work]]:
    """Where methods learn: in a process of its own, which is started with the first that asks, or in this one."""
    with contextlib.ExitStack() as stack:

        @functools.cache
        def work() -> Work:
            from far_app.learning.apart.here import WorkHere
            from far_app.learning.apart.process import WorkProcess

            here = WorkHere(options.learning_threads)
            if not options.learning_apart:
                return here
            arguments = ["--folder", str(folder), "--threads", str(options.learning_threads)]
            arguments += ["--torch-threads", str(options.torch_threads)]
            child = family.add(Child("learning", "far_app.learning.apart.server", arguments, folder))
            process = WorkProcess(folder, lambda: None if child.alive() else child.last_words(), here)
            stack.callback(process.close)
            return process

        yield work


@contextlib.contextmanager
def connected(folder: Path, hardware: Child | None) -> Iterator[RemoteRobot]:
    """The robot behind the hw server, once it shows its first observation."""
    deadline = time.monotonic() + HARDWARE_PATIENCE
    robot = None
    while robot is None:
        if hardware is not None:
            hardware.check()
        try:
            robot = RemoteRobot(Endpoints.in_folder(folder), connect_timeout=1.0 if hardware is not None else 5.0)
        except ArmTaken:
            raise
        except RobotError as error:
            if time.monotonic() > deadline:
                raise RobotError(
                    f"the hw server showed nothing within {HARDWARE_PATIENCE:.0f} s of its start: {error}"
                ) from error
    try:
        yield robot
    finally:
        robot.close()


def wait_for_page(page: Child, host: str, port: int) -> None:
    """Returns once the page is served."""
    deadline = time.monotonic() + PAGE_PATIENCE
    while not _serves(host, port):
        page.check()
        if time.monotonic() > deadline:
            raise FarError(f"the page did not answer at {host}:{port} within {PAGE_PATIENCE:.0f} s")
        time.sleep(0.05)


@contextlib.contextmanager
def revived(family: Family, page: Child | None) -> Iterator[None]:
    """While inside, a page that dies is started again, from a thread of its own."""
    ended = threading.Event()

    def watch() -> None:
        nice(0)  # which the page inherits
        while page is not None and not ended.wait(0.5):
            family.revive(page)

    thread = threading.Thread(target=watch, name="page-watch", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _serves(host: str, port: int) -> bool:
    connection = http.client.HTTPConnection(host, port, timeout=1.0)
    try:
        connection.request("GET", "/")
        return connection.getresponse().status < 500
    except (OSError, http.client.HTTPException):
        return False
    finally:
        connection.close()
