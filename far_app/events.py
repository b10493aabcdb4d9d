"""What a trial tells whoever drives it, and asks of them: the events of trial.py, attempt.py and guided.py."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

from far_app.protocols import PlanRequest
from far_app.types import ActionChunk, Adaptation, Attempt, Step, Trial


@dataclass(frozen=True, kw_only=True)
class Tick:
    """Let one tick pass; answered with the tick's absolute deadline, seconds on the robot's clock: the machine's
    monotonic clock in real time, simulated time in lockstep. By then the tick's target is to be with the arm."""

    phase: str
    """"attempt", "judging" (the arm is held, the operator is asked) or "homing"."""
    attempt_index: int
    step: Step | None = None
    """The step that the last tick completed, with its acknowledged action and lateness."""
    between: bool = False
    """At reduced speed: a tick on the way from one of the policy's to the next."""


class AfterHold(float):
    """The deadline of the first tick after the arm was held (pause, stale observations): plans and histories are
    forgotten and motion starts from the measured pose."""


@dataclass(frozen=True, kw_only=True)
class AttemptStarted:
    attempt_index: int
    policy_version: str


@dataclass(frozen=True, kw_only=True)
class AttemptEnded:
    """Takes no time; a driver that must wait (fault, countdown) waits here."""

    attempt: Attempt
    last: bool
    """No retry follows."""


@dataclass(frozen=True, kw_only=True)
class Adapted:
    adaptation: Adaptation


Event = Tick | PlanRequest | AttemptStarted | AttemptEnded | Adapted
Answer = float | ActionChunk | None
"""A deadline to a Tick, a chunk to a PlanRequest, nothing to the others."""
TrialEvents = Generator[Event, Answer, Trial]
AttemptEvents = Generator[Event, Answer, Attempt]
