"""Who leads an arm: one at a time. The first app that asks, until it leaves or falls silent (`Lease`); and one hw
server for a controller on this machine (`claim`).
"""

from __future__ import annotations

import fcntl
import getpass
import json
import os
import stat
import tempfile
import time
from pathlib import Path

from far_app.errors import ArmTaken, RobotError
from far_app.station import spoken

LAPSE = 3.0
"""Seconds of an app's silence after which another may lead the arm. It is held long before that."""


class Lease:
    """Kept by the command thread; apps of other machines ask for it with every look at the clock. Nobody asks the hw
    server that an app started for itself: its holder stays empty, and everything is admitted."""

    def __init__(self) -> None:
        self._holder, self._heard = "", 0.0

    def ask(self, who: str, now: float) -> str:
        """Take it if it is free, or renew it; returns who holds it."""
        if who and self.holder(now) in ("", who):
            self._holder, self._heard = who, now
        return self.holder(now)

    def leave(self, who: str) -> None:
        if who == self._holder:
            self._holder = ""

    def holder(self, now: float) -> str:
        """Who holds it; empty when it is free."""
        return self._holder if now - self._heard <= LAPSE else ""

    def refusal(self, sender: str, now: float) -> str:
        """Why a message of this sender must not move the arm; empty when it may."""
        holder = self.holder(now)
        return f"the arm is led by {spoken(holder)}; end that run first" if holder not in ("", sender) else ""


def claim(address: str, port: int) -> int:
    """This process alone, of all on this machine, drives the controller, for as long as it lives (the file descriptor
    that is returned stays open). Raises ArmTaken, which names who does already."""
    path = Path(tempfile.gettempdir()) / f"far-arm-{address}-{port}.lock"
    lock = _opened(path)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        raise ArmTaken(
            f"the controller at {address}:{port} is driven by {_told(path)} already; end that first: two programs "
            "would fight over one arm"
        ) from None
    os.ftruncate(lock, 0)
    since = {"user": getpass.getuser(), "process": os.getpid(), "app": os.getppid(), "since": time.monotonic()}
    os.pwrite(lock, json.dumps(since).encode(), 0)
    return lock


def _opened(path: Path) -> int:
    """A regular file that every user may lock; the system refuses to create one that another user owns."""
    for flags in (os.O_RDWR, os.O_RDWR | os.O_CREAT | os.O_EXCL, os.O_RDWR):
        try:
            lock = os.open(path, flags | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
        except (FileNotFoundError, FileExistsError):
            continue
        except OSError as error:
            raise RobotError(f"cannot lock {path} ({error.strerror}); remove that file") from error
        if flags & os.O_CREAT:
            os.fchmod(lock, stat.S_IRUSR | stat.S_IWUSR | stat.S_IRGRP | stat.S_IWGRP | stat.S_IROTH | stat.S_IWOTH)
        return lock
    raise RobotError(f"cannot lock {path}: it comes and goes; remove that file")


def _told(path: Path) -> str:
    try:
        words = json.loads(path.read_text())
        minutes = (time.monotonic() - words["since"]) / 60.0
        return f"{words['user']}'s program (hw server {words['process']}, started by {words['app']}, {minutes:.0f} min)"
    except (OSError, ValueError, KeyError, TypeError):
        return "another program"
