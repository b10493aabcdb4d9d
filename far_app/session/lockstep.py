"""A trial as fast as the machine goes: the same far_app/trial.py, on a clock that the driver advances.

Called by tests, benchmarks and evaluations; the robot lives in the same process and passes one policy tick when told.
"""

from __future__ import annotations

from collections.abc import Callable

from far_app.protocols import Method, PlanRequest
from far_app.session.planners import plan_one
from far_app.trial import Event, RunningAdaptation, Tick, TrialEvents
from far_app.types import Adaptation, Attempt, Trial


def run_lockstep(
    events: TrialEvents, advance: Callable[[], float], listen: Callable[[Event], None] = lambda event: None
) -> Trial:
    """Drive one trial to its end. `advance` lets one tick of robot time pass and returns the new time, seconds."""
    answer = None
    while True:
        try:
            event = events.send(answer)
        except StopIteration as end:
            return end.value
        listen(event)
        if isinstance(event, Tick):
            answer = advance()
        elif isinstance(event, PlanRequest):
            answer = plan_one(event)
        else:
            answer = None


class FinishedAdaptation:
    """An adaptation that is already there."""

    def __init__(self, adaptation: Adaptation) -> None:
        self._adaptation = adaptation

    def done(self) -> bool:
        return True

    def result(self) -> Adaptation:
        return self._adaptation


def adapt_at_once(method: Method, attempt: Attempt) -> RunningAdaptation:
    """StartAdaptation for lockstep: learn, then go on."""
    return FinishedAdaptation(method.adapt(attempt, lambda: False, lambda step: None))
