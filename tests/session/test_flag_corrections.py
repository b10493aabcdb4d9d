"""The operator's word on a chunk that comes while an adaptation runs: it learns anew; later ones are refused."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

from far_app.session.adaptation import BackgroundAdaptation, unchanged
from far_app.types import Attempt, FlagCorrection, Judge, Outcome

WORD = FlagCorrection(tick=3, flagged=False, by="ada")


class Slow:
    """Learns until it is told to go on, or superseded."""

    def __init__(self) -> None:
        self.policy: Any = SimpleNamespace(version="base")
        self.began, self.go_on = threading.Semaphore(0), threading.Event()
        self.seen: list[tuple[FlagCorrection, ...]] = []

    def adapt(self, attempt: Attempt, cancelled: Any, progress: Any) -> Any:
        self.seen.append(attempt.corrections)
        self.began.release()
        while not self.go_on.wait(0.005):
            if cancelled():
                return unchanged("base", "cancelled")
        return unchanged("base", "adapted")


def failed() -> Attempt:
    observation: Any = SimpleNamespace()
    outcome = Outcome(success=False, judged_by=Judge.HORIZON)
    return Attempt(index=1, scene_seed=1, steps=(), final=observation, outcome=outcome, policy_version="base")


def test_a_word_in_time_begins_the_adaptation_anew_with_it() -> None:
    method = Slow()
    running = BackgroundAdaptation(method, failed(), limit=30.0)  # type: ignore[arg-type]
    assert method.began.acquire(timeout=5)
    assert running.correct(WORD)
    assert method.began.acquire(timeout=5)
    method.go_on.set()
    running._thread.join(timeout=5)
    assert method.seen == [(), (WORD,)] and running.result().status == "adapted"
    assert not running.correct(WORD)


def test_a_cancelled_adaptation_stays_cancelled() -> None:
    method = Slow()
    running = BackgroundAdaptation(method, failed(), limit=30.0)  # type: ignore[arg-type]
    assert method.began.acquire(timeout=5)
    running.cancel(wait=True)
    assert not running.correct(WORD) and len(method.seen) == 1
