"""The attempt view's sockets: questions and corrections to the app, answers from it. One thread, no waiting."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import zmq

from far_app.endpoints import Endpoints
from far_app.telemetry import Telemetry
from far_app.what_if import Answer, Answerer
from far_app.wire import WireError, pack, unpack

log = logging.getLogger(__name__)

SILENT_AFTER = 3.0
"""Seconds without a word after which nobody answers or keeps corrections."""


class Link:
    """To a running session (which keeps corrections) or to `far replay` (which answers questions too)."""

    def __init__(self, run_folder: Path) -> None:
        at = Endpoints.in_folder(run_folder)
        self._context: zmq.Context[Any] = zmq.Context(io_threads=1)
        self._heard = self._context.socket(zmq.SUB)
        self._heard.setsockopt(zmq.RCVHWM, 200)
        self._heard.subscribe(b"")
        self._heard.connect(at.telemetry)
        self._said = self._context.socket(zmq.PUSH)
        self._said.setsockopt(zmq.SNDHWM, 16)
        self._said.setsockopt(zmq.IMMEDIATE, 1)
        self._said.connect(at.intents)
        for socket in (self._heard, self._said):
            socket.setsockopt(zmq.LINGER, 0)
        self.answerer: Answerer | None = None
        self._answerer_at = self._app_at = float("-inf")

    def poll(self) -> Iterator[Answer]:
        """Answers that came; who answers is remembered."""
        while True:
            try:
                message = unpack(self._heard.recv(zmq.NOBLOCK))
            except zmq.Again:
                break
            except WireError as error:
                log.warning("refused a message: %s", error)
                continue
            now = time.monotonic()
            if isinstance(message, Answer):
                self._answerer_at = now
                yield message
            elif isinstance(message, Answerer):
                self.answerer, self._answerer_at = message, now
            elif isinstance(message, Telemetry):
                self._app_at = now

    @property
    def critics(self) -> tuple[str, ...]:
        """The critics that can be asked; empty where nobody answers."""
        fresh = time.monotonic() - self._answerer_at < SILENT_AFTER
        return self.answerer.critics if self.answerer is not None and fresh else ()

    @property
    def cannot_correct(self) -> str:
        """Why the operator's word would not be kept; "" when it would."""
        heard = max(self._answerer_at, self._app_at)
        return "" if time.monotonic() - heard < SILENT_AFTER else "nobody keeps it: open with far replay"

    def send(self, message: Any) -> bool:
        """False when nobody takes it; it is dropped then, never sent late."""
        try:
            self._said.send(pack(message), zmq.NOBLOCK)
        except zmq.Again:
            return False
        return True

    def close(self) -> None:
        self._context.destroy(linger=0)
