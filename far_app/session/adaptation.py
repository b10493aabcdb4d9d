"""FCPA in the background while the arm goes home: a thread at lower priority, with a time limit and cancellation."""

from __future__ import annotations

import dataclasses
import logging
import threading
import time

import numpy as np

from far_app.protocols import Method
from far_app.scheduling import BACKGROUND_NICENESS, nice
from far_app.types import Adaptation, AdaptationStep, Attempt, FlagCorrection

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
        self._words: list[FlagCorrection] = []
        self._late = False
        """Too late for another word of the operator's."""
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._work, args=(method, attempt), name="adaptation", daemon=True)
        self._thread.start()

    def cancel(self, wait: bool = False) -> None:
        """Ask it to end without a new policy version; `wait` until it has (between two batches)."""
        self._cancelled.set()
        if wait:
            self._thread.join()

    def correct(self, word: FlagCorrection) -> bool:
        """The operator's word on a chunk: learn anew with it; False when it comes too late. The result's `corrections`
        tell which words counted."""
        with self._lock:
            if self._late or self._cancelled.is_set():
                return False
            self._words.append(word)
            return True

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
            self._adaptation = self._learn(method, attempt)
        except Exception as error:
            log.exception("the adaptation failed; the previous policy version retries")
            self._adaptation = unchanged(self._base_version, "failed", f"{type(error).__name__}: {error}")
        self.known = self._adaptation

    def _learn(self, method: Method, attempt: Attempt) -> Adaptation:
        """Until no word of the operator's came in between."""
        while True:
            words = tuple(self._words)

            def superseded(known: int = len(words)) -> bool:
                return self._cancelled.is_set() or len(self._words) > known

            adaptation = method.adapt(dataclasses.replace(attempt, corrections=words), superseded, self._hear)
            with self._lock:
                again = adaptation.status == "cancelled" and len(self._words) > len(words)
                if self._cancelled.is_set() or not again:
                    self._late = True
                    return adaptation
            self.progress = []

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
