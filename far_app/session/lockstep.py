"""A trial as fast as the machine goes: the same far_app/trial.py, on a clock that the driver advances.

Called by tests, benchmarks and evaluations; the robot lives in the same process and passes one policy tick when told.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field, replace
from typing import TypeVar

from far_app.errors import RobotError
from far_app.events import Adapted, AttemptEnded, Tick, TrialEvents
from far_app.protocols import Method, PlanRequest
from far_app.session.planners import plan_one, plan_together
from far_app.trial import RunningAdaptation
from far_app.types import ActionChunk, Adaptation, Attempt, Judge, Trial

Advance = Callable[[], float]
"""Lets one tick of a robot's time pass and returns the new time, seconds."""
MOST_RESCUES = 10
"""In one trial; then it is given up."""


@dataclass
class Lane:
    """A trial that is under way, alone or beside others."""

    events: TrialEvents
    advance: Advance
    free: Callable[[], bool] = lambda: False
    """The operator's part: takes a latched arm out of what it is caught in, hand open, and sends it
    home; objects stay. False when there was nothing to free, or nobody to do it."""
    rescues: int = 0
    """How often that was needed."""
    answer: float | ActionChunk | None = None
    attempts: list[Attempt] = field(default_factory=list)
    adaptations: list[Adaptation] = field(default_factory=list)

    def step(self) -> PlanRequest | Trial:
        """On to where it needs a chunk, or to its end. Raises what the trial raises, and RobotError for a latched
        arm."""
        while True:
            try:
                event = self.events.send(self.answer)
            except StopIteration as end:
                return replace(end.value, rescues=self.rescues)
            self.answer = None
            if isinstance(event, Tick):
                self.answer = self.advance()
                if event.phase == "homing":
                    self._rescued()
            elif isinstance(event, PlanRequest):
                return event
            elif isinstance(event, AttemptEnded):
                if event.attempt.outcome.judged_by is Judge.FAULT and not self._rescued():
                    raise RobotError(event.attempt.outcome.note)
                self.attempts.append(event.attempt)
            elif isinstance(event, Adapted):
                self.adaptations.append(event.adaptation)

    def _rescued(self) -> bool:
        if not self.free():
            return False
        self.rescues += 1
        if self.rescues > MOST_RESCUES:
            raise RobotError(f"the arm latched {self.rescues} times in one trial (limit {MOST_RESCUES}); given up")
        return True


def run_lockstep(events: TrialEvents, advance: Advance) -> Trial:
    """Drive one trial to its end."""
    lane = Lane(events, advance)
    while isinstance(outcome := lane.step(), PlanRequest):
        lane.answer = plan_one(outcome)
    return outcome


J = TypeVar("J", bound=Hashable)
Take = Callable[[], J | None]
"""The next job; None while there is none (one that ends may bring more)."""
Start = Callable[[J, int], Lane]
"""(job, number of the lane) → its trial, on that lane's robot."""


def run_together(
    take: Take[J], lanes: int, start: Start[J], failed: Callable[[J, Lane, RobotError], Trial]
) -> Iterator[tuple[J, Trial]]:
    """Drive many trials side by side, each lane one after the other, so that they share batches of inference. Yields
    each as it ends, until none runs and there is no job; `failed` makes a Trial of one whose robot gave up."""
    running: dict[int, tuple[J, Lane]] = {}
    while True:
        for number in range(lanes):
            if number not in running and (job := take()) is not None:
                running[number] = job, start(job, number)
        if not running:
            return
        requests: dict[int, PlanRequest] = {}
        for number, (job, lane) in list(running.items()):
            try:
                outcome = lane.step()
            except RobotError as error:
                outcome = failed(job, lane, error)
            if isinstance(outcome, PlanRequest):
                requests[number] = outcome
            else:
                del running[number]
                yield job, outcome
        for number, chunk in plan_together(requests).items():
            running[number][1].answer = chunk


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
