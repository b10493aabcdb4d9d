"""Failure-Aware Retry: the paper's Algorithm 1, one page.

A trial is a generator. It yields a Tick once a tick, so that whoever drives it (the 30 Hz session, a lockstep
evaluation, a test) can pace, pause or abort it anywhere; it holds no clock, no thread and no socket of its own.

    for i = 1 … N:
        execute the policy, collect τ_i                        execute()
        if Success(τ_i): break
        flag failure-inducing chunks, build pairs, update      method.adapt, in the background
        return the robot to its start pose                     go_home()
        retry with the updated policy and perturbation
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from far_app.aggregation import Plan
from far_app.alarm import Alarm, NoAlarm
from far_app.config import TaskConfig
from far_app.motion import ActionScale, TargetIntegrator
from far_app.protocols import (
    NOBODY,
    Heartbeat,
    Hold,
    Home,
    Method,
    Person,
    Planner,
    PlanRequest,
    Reset,
    Robot,
    SuccessDetector,
)
from far_app.types import (
    ACTION_DIM,
    ARM_DIMS,
    ActionChunk,
    Adaptation,
    Attempt,
    Judge,
    Observation,
    Outcome,
    RobotMode,
    Step,
    Trial,
)

NO_ALARM = NoAlarm()
FADE_IN = 10
"""Ticks over which the policy's motion comes back after a person handed the arm back."""
HELP_LIMIT = 3600
"""Ticks for which a person may have the arm in one attempt (two minutes at 30 Hz); then it ends as at its horizon."""


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
TrialEvents = Generator[Event, float | ActionChunk | None, Trial]


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
    robot: Robot,
    planner: Planner,
    method: Method,
    detector: SuccessDetector,
    task: TaskConfig,
    scale: ActionScale,
    start_adaptation: StartAdaptation,
    stretch: int = 1,
    alarm: Alarm = NO_ALARM,
    person: Person = NOBODY,
    chance: int | None = None,
) -> TrialEvents:
    """Algorithm 1. Returns the trial's attempts and adaptations; afterwards the method holds the base policy again.

    `chance` keys noise and perturbation, so that a scene can be repeated with other draws; the scene's seed does by
    default."""
    attempts: list[Attempt] = []
    adaptations: list[Adaptation] = []
    chance = scene_seed if chance is None else chance
    method.begin(chance)
    robot.request(Reset(seed=scene_seed))
    yield from go_home(robot, attempt_index=1)
    for i in range(1, task.max_attempts + 1):
        yield AttemptStarted(attempt_index=i, policy_version=method.policy.version)
        slowly = stretch if i == 1 else 1
        attempt = yield from execute(
            robot, planner, method, detector, task, scale, scene_seed, i, slowly, alarm, person, chance
        )  # fmt: skip
        attempts.append(attempt)
        last = attempt.outcome.success or i == task.max_attempts
        yield AttemptEnded(attempt=attempt, last=last)
        if last:
            break
        adaptation = start_adaptation(method, attempt)
        yield from go_home(robot, attempt_index=i + 1, until=adaptation.done)
        adaptations.append(adaptation.result())
        yield Adapted(adaptation=adaptations[-1])
    method.begin(chance)
    return Trial(scene_seed=scene_seed, attempts=tuple(attempts), adaptations=tuple(adaptations))


def execute(
    robot: Robot,
    planner: Planner,
    method: Method,
    detector: SuccessDetector,
    task: TaskConfig,
    scale: ActionScale,
    scene_seed: int,
    index: int,
    stretch: int = 1,
    alarm: Alarm = NO_ALARM,
    person: Person = NOBODY,
    chance: int | None = None,
) -> Generator[Event, float | ActionChunk | None, Attempt]:
    """One attempt. A tick: observe → judge → chunk → aggregate → perturb → target.

    Stretched, each of the policy's ticks takes so many of the robot's: the same way and the same horizon, slower. While
    a person steers, theirs is the action and the horizon stands still; afterwards the policy plans anew and its motion
    fades in."""
    spec = method.policy.spec
    shares = np.array((stretch,) * ARM_DIMS + (1,))  # the gripper is told the whole of its action in every part
    plan = Plan(horizon=spec.horizon)
    chance = scene_seed if chance is None else chance
    perturbation = method.perturb(index, chance)
    history: deque[Observation] = deque(maxlen=spec.n_obs)
    steps: list[Step] = []
    step: Step | None = None
    helped, since = 0, FADE_IN  # ticks a person acted, ticks the policy has had the arm again
    detector.begin()
    alarm.begin()
    planner.begin(method.policy)
    integrator = TargetIntegrator(scale, robot.observe().eef)

    for t in itertools.count():
        deadline = yield Tick(phase="attempt", attempt_index=index, step=steps[-1] if steps else None)
        assert isinstance(deadline, float), "a Tick is answered with its deadline"
        observation = robot.observe()
        if step is not None:
            steps.append(completed(step, observation, integrator, shares))
        if isinstance(deadline, AfterHold):
            plan, integrator = Plan(horizon=spec.horizon), TargetIntegrator(scale, observation.eef)
            history.clear()
        outcome = detector.judge(observation) or fault(observation)
        if outcome is None and not person.steers:
            outcome = alarm.judge(plan, t)
            if outcome is None and t - helped == task.horizon and detector.patience > 0:
                outcome = yield from wait_for_word(robot, detector, index, person)
                if person.steers:  # the arm was held: on from where it stands
                    observation = robot.observe()
                    integrator = TargetIntegrator(scale, observation.eef)
        over = helped == HELP_LIMIT or (t - helped == task.horizon and not person.steers)
        if outcome is not None or over:
            break

        history.extend([observation] * (spec.n_obs if not history else 1))
        for chunk in (yield from planner.plan(tuple(history), t, (chance, index, t))):
            plan.add(chunk)
            if chunk.tick < len(steps):  # V(s_k) of an earlier tick, computed in time for the record
                steps[chunk.tick] = replace(steps[chunk.tick], value=chunk.value)
        asked = person.action(observation)
        if asked is None and step is not None and step.intervention:  # handed back: older plans are void
            plan, since = plan.newest(), 0
            alarm.begin()
        action = asked if asked is not None else plan.action(t)  # â_t = g(chunks)
        delta = perturbation(t) if asked is None and action is not None else np.zeros(ACTION_DIM)  # δ_t
        commanded = np.clip(action + delta, -1.0, 1.0) if action is not None else hold_still(steps)
        if asked is not None:
            helped += 1
        elif since < FADE_IN:
            since += 1
            commanded = commanded * np.array((since / FADE_IN,) * ARM_DIMS + (1.0,))
        part, here = commanded / shares, observation
        for _ in range(stretch - 1):
            robot.send(integrator.target(part, here.eef, deadline))
            deadline = yield Tick(phase="attempt", attempt_index=index, between=True)
            assert isinstance(deadline, float), "a Tick is answered with its deadline"
            here = robot.observe()
            for ack in here.acks:
                integrator.executed(ack)
            if isinstance(deadline, AfterHold):
                plan, integrator = Plan(horizon=spec.horizon), TargetIntegrator(scale, here.eef)
                history.clear()
        target = integrator.target(part, here.eef, deadline)
        robot.send(target)
        step = Step(
            tick=t, seq=target.seq, stamp=observation.stamp, deadline=deadline, observation=observation,
            action=action if action is not None else commanded, perturbation=delta, commanded=commanded,
            sent=np.full(ACTION_DIM, np.nan), chunk_tick=plan.newest_tick, starved=action is None,
            policy_version=method.policy.version, value=plan.value(t), reward=observation.reward,
            success=observation.success, intervention=asked is not None,
        )  # fmt: skip

    return Attempt(
        index=index, scene_seed=scene_seed, steps=tuple(steps), final=observation,
        outcome=outcome or Outcome(success=False, judged_by=Judge.HORIZON), policy_version=method.policy.version,
    )  # fmt: skip


def wait_for_word(
    robot: Robot, detector: SuccessDetector, index: int, person: Person
) -> Generator[Event, float | ActionChunk | None, Outcome | None]:
    """The horizon is over and nobody has judged: hold the arm and ask the operator, for so long as the detector says.
    None when no word came, or a person took the arm instead."""
    robot.request(Hold(reason="waiting for the operator: success or failure?"))
    began = now = yield Tick(phase="judging", attempt_index=index)
    assert isinstance(began, float) and isinstance(now, float), "a Tick is answered with its deadline"
    while now < began + detector.patience and not person.steers:
        observation = robot.observe()
        outcome = detector.judge(observation) or fault(observation)
        if outcome is not None:
            return outcome
        now = yield Tick(phase="judging", attempt_index=index)
        assert isinstance(now, float), "a Tick is answered with its deadline"
    return None


def go_home(
    robot: Robot, attempt_index: int, until: Callable[[], bool] = lambda: True
) -> Generator[Event, float | ActionChunk | None, None]:
    """Return the arm to its start pose, scene untouched, and wait for `until`. Uses none of the horizon's ticks."""
    robot.request(Home())
    while True:
        yield Tick(phase="homing", attempt_index=attempt_index)
        robot.request(Heartbeat())
        status = robot.observe().status
        if status.mode is RobotMode.LATCHED or (status.at_home and until()):
            return


def completed(step: Step, observation: Observation, integrator: TargetIntegrator, shares: np.ndarray) -> Step:
    """The step with what was sent and how late, once its target (the last of its parts) is acknowledged."""
    for ack in observation.acks:
        executed = integrator.executed(ack)
        if ack.seq == step.seq:
            sent = shares * (executed if executed is not None else step.sent)
            return replace(step, sent=sent, lateness=ack.accepted - ack.due)
    return step


def fault(observation: Observation) -> Outcome | None:
    """A latched arm ends the attempt as a failure, with the robot's own words."""
    if observation.status.mode is not RobotMode.LATCHED:
        return None
    return Outcome(success=False, judged_by=Judge.FAULT, note=observation.status.reason)


def hold_still(steps: list[Step]) -> np.ndarray:
    """No plan left: no motion, the gripper as it was."""
    action = np.zeros(ACTION_DIM)
    action[6] = steps[-1].commanded[6] if steps else -1.0
    return action
