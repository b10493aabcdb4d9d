"""A success detector that looks in a thread of its own, so that a network in it costs the loop's tick nothing."""

from __future__ import annotations

import logging
import threading

from far_app.protocols import SuccessDetector
from far_app.scheduling import PROMPT_NICENESS, nice
from far_app.types import Observation, Outcome

log = logging.getLogger(__name__)


class WatchingDetector:
    """far_app.protocols.SuccessDetector around a slow one: looks at the newest observation, says what was found on one
    a tick or two earlier. One that fails says nothing more in this attempt, and the operator is asked at its end."""

    def __init__(self, detector: SuccessDetector, wait: float) -> None:
        """`wait`: seconds for the operator's word where the detector failed."""
        self._detector, self._wait = detector, wait
        self._changed = threading.Condition()
        self._newest: Observation | None = None
        self._outcome: Outcome | None = None
        self._fresh = True
        """The next look is an attempt's first."""
        self._failed = self._closing = False
        self._epoch = 0
        self._thread = threading.Thread(target=self._work, name="success", daemon=True)
        self._thread.start()

    @property
    def patience(self) -> float:
        return self._wait if self._failed else self._detector.patience

    def begin(self) -> None:
        with self._changed:
            self._newest = self._outcome = None
            self._fresh, self._failed = True, False
            self._epoch += 1

    def judge(self, observation: Observation) -> Outcome | None:
        with self._changed:
            self._newest = observation
            self._changed.notify_all()
            return self._outcome

    def close(self) -> None:
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(timeout=10.0)  # a thread inside torch at the interpreter's end would abort it

    def _work(self) -> None:
        nice(PROMPT_NICENESS)
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closing or (self._newest is not None and not self._failed))
                if self._closing:
                    return
                observation, self._newest = self._newest, None
                epoch, fresh, self._fresh = self._epoch, self._fresh, False
            assert observation is not None
            outcome, failed = None, False
            try:
                if fresh:
                    self._detector.begin()
                outcome = self._detector.judge(observation)
            except Exception:
                log.exception("the success detector failed; the operator is asked at the attempt's end")
                failed = True
            with self._changed:
                if epoch == self._epoch:
                    self._outcome, self._failed = self._outcome or outcome, failed
