"""Failure-Aware Retry: the paper's Algorithm 1, one page.

A trial is a generator. It yields a Tick once a tick, so that whoever drives it (the 30 Hz session, a lockstep
evaluation, a test) can pace, pause or abort it anywhere; it holds no clock, no thread and no socket of its own.

    for i = 1 … N:
        execute the policy, collect τ_i                        execute(), in attempt.py
        if Success(τ_i): break
        flag failure-inducing chunks, build pairs, update      method.adapt, in the background
        return the robot to its start pose                     go_home()
        retry with the updated policy and perturbation
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Protocol

from far_app.attempt import Setting, execute
from far_app.events import Adapted, Answer, AttemptEnded, AttemptStarted, Event, Tick, TrialEvents
from far_app.protocols import Heartbeat, Home, Method, Reset, Robot
from far_app.types import Adaptation, Attempt, RobotMode, Trial


class RunningAdaptation(Protocol):
    """An adaptation in the background, as the driver started it."""

    def done(self) -> bool:
        """Finished, failed, or over its time limit."""
        ...

    def result(self) -> Adaptation: ...


StartAdaptation = Callable[[Method, Attempt], RunningAdaptation]
"""Runs method.adapt(attempt): in a thread for a session, at once in lockstep."""


def trial(
    scene_seed: int,
    method: Method,
    setting: Setting,
    start_adaptation: StartAdaptation,
    chance: int | None = None,
) -> TrialEvents:
    """Algorithm 1. Returns the trial's attempts and adaptations; afterwards the method holds the base policy again.

    `chance` keys noise and perturbation, so that a scene can be repeated with other draws; the scene's seed does by
    default."""
    robot, most = setting.robot, setting.task.max_attempts
    chance = scene_seed if chance is None else chance
    attempts: list[Attempt] = []
    adaptations: list[Adaptation] = []
    method.begin(chance)
    robot.request(Reset(seed=scene_seed))
    yield from go_home(robot, attempt_index=1)
    for i in range(1, most + 1):
        yield AttemptStarted(attempt_index=i, policy_version=method.policy.version)
        attempt = yield from execute(setting, method, scene_seed, i, chance)
        attempts.append(attempt)
        last = attempt.outcome.success or i == most
        yield AttemptEnded(attempt=attempt, last=last)
        if last:
            break
        adaptation = start_adaptation(method, attempt)
        yield from go_home(robot, attempt_index=i + 1, until=adaptation.done)
        adaptations.append(adaptation.result())
        yield Adapted(adaptation=adaptations[-1])
    method.begin(chance)
    return Trial(scene_seed=scene_seed, attempts=tuple(attempts), adaptations=tuple(adaptations))


def go_home(
    robot: Robot, attempt_index: int, until: Callable[[], bool] = lambda: True
) -> Generator[Event, Answer, None]:
    """Return the arm to its start pose, scene untouched, and wait for `until`. Uses none of the horizon's ticks."""
    robot.request(Home())
    while True:
        yield Tick(phase="homing", attempt_index=attempt_index)
        robot.request(Heartbeat())
        status = robot.observe().status
        if status.mode is RobotMode.LATCHED or (status.at_home and until()):
            return
