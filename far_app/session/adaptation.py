"""FCPA in the background while the arm goes home: a thread at lower priority, with a time limit and cancellation."""

from __future__ import annotations

import dataclasses
import logging
import threading
import time

import numpy as np

from far_app.protocols import Method
from far_app.scheduling import BACKGROUND_NICENESS, nice
from far_app.types import Adaptation, AdaptationStep, Attempt

log = logging.getLogger(__name__)

_GRACE = 0.5
"""Seconds a cancelled adaptation is given to notice (it looks between batches)."""


class BackgroundAdaptation:
    """far_app/trial.py's RunningAdaptation. Over its limit it is cancelled and counts as done."""

    def __init__(self, method: Method, attempt: Attempt, limit: float) -> None:
        self.progress: list[AdaptationStep] = []
        self.known: Adaptation | None = None
        """What is known so far: attribution, then pairs, then all."""
        self._base_version = method.policy.version
        self._deadline = time.monotonic() + limit
        self._limit = limit
        self._cancelled = threading.Event()
        self._why = "cancelled"
        self._adaptation: Adaptation | None = None
        self._thread = threading.Thread(target=self._work, args=(method, attempt), name="adaptation", daemon=True)
        self._thread.start()

    def cancel(self, wait: bool = False) -> None:
        """Ask it to end without a new policy version; `wait` until it has (between two batches)."""
        self._cancelled.set()
        if wait:
            self._thread.join()

    @property
    def running(self) -> bool:
        return self._thread.is_alive()

    def done(self) -> bool:
        if self._thread.is_alive() and not self._cancelled.is_set() and time.monotonic() > self._deadline:
            self._why = "timeout"
            self._cancelled.set()
        return not self._thread.is_alive() or self._cancelled.is_set()

    def result(self) -> Adaptation:
        """What it came to; never raises and never waits longer than a batch."""
        self._thread.join(timeout=_GRACE)
        if self._why == "timeout":
            note = f"the adaptation was not done within {self._limit:g} s; the previous policy version retries"
            if self._adaptation is None:
                return unchanged(self._base_version, "timeout", note)
            if self._adaptation.status == "cancelled":
                return dataclasses.replace(self._adaptation, status="timeout", note=note)
        return self._adaptation or unchanged(self._base_version, self._why)

    def _work(self, method: Method, attempt: Attempt) -> None:
        nice(BACKGROUND_NICENESS)
        try:
            self._adaptation = method.adapt(attempt, self._cancelled.is_set, self._hear)
        except Exception as error:
            log.exception("the adaptation failed; the previous policy version retries")
            self._adaptation = unchanged(self._base_version, "failed", f"{type(error).__name__}: {error}")
        self.known = self._adaptation

    def _hear(self, news: AdaptationStep | Adaptation) -> None:
        if isinstance(news, Adaptation):
            self.known = news
        else:
            self.progress.append(news)


def unchanged(version: str, status: str, note: str = "") -> Adaptation:
    """An adaptation that changed nothing."""
    return Adaptation(
        status=status, base_version=version, version=version, values=np.zeros(0), value_changes=np.zeros(0),
        threshold=float("nan"), flagged=(), note=note,
    )  # fmt: skip
