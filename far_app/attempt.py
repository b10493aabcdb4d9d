"""One attempt: the policy runs until somebody judges, the horizon is over, or the arm latches.

    a tick:  observe → judge → chunk → aggregate → perturb → target             â_t = g(chunks),  ã_t = â_t + δ_t

The generator that trial.py runs once for each attempt; see there for who drives it.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from far_app.aggregation import Plan
from far_app.alarm import Alarm, NoAlarm
from far_app.config import TaskConfig
from far_app.events import AfterHold, Answer, AttemptEvents, Event, Tick
from far_app.motion import ActionScale, TargetIntegrator
from far_app.protocols import NOBODY, Hold, Method, Person, Planner, PolicySpec, Robot, SuccessDetector
from far_app.types import (
    ACTION_DIM,
    ARM_DIMS,
    Attempt,
    Judge,
    Observation,
    Outcome,
    Pose,
    RobotMode,
    Step,
)

NO_ALARM = NoAlarm()
FADE_IN = 10
"""Ticks over which the policy's motion comes back after a person handed the arm back."""
HELP_LIMIT = 3600
"""Ticks for which a person may have the arm in one attempt (two minutes at 30 Hz); then it ends as at its horizon."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What all attempts of a trial have in common, beside the method."""

    robot: Robot
    planner: Planner
    detector: SuccessDetector
    task: TaskConfig
    scale: ActionScale
    alarm: Alarm = NO_ALARM
    person: Person = NOBODY
    stretch: int = 1
    """Ticks of the robot's that each of the policy's takes in the first attempt: the same way and the same horizon,
    slower."""


class Motion:
    """What an attempt's next targets follow from: the plans that still reach ahead, the observations the next one is
    made from, the last target."""

    def __init__(self, spec: PolicySpec, scale: ActionScale, measured: Pose) -> None:
        self._spec, self._scale = spec, scale
        self.restart(measured)

    def restart(self, measured: Pose) -> None:
        """The arm was held: everything is forgotten and motion starts from the measured pose."""
        self.plan = Plan(horizon=self._spec.horizon)
        self.history: deque[Observation] = deque(maxlen=self._spec.n_obs)
        self.go_on_from(measured)

    def go_on_from(self, measured: Pose) -> None:
        """The plans hold, the arm stands elsewhere."""
        self.integrator = TargetIntegrator(self._scale, measured)

    def see(self, observation: Observation) -> tuple[Observation, ...]:
        """The history with this observation, the first one repeated at the start."""
        self.history.extend([observation] * (1 if self.history else self._spec.n_obs))
        return tuple(self.history)


def execute(setting: Setting, method: Method, scene_seed: int, index: int, chance: int) -> AttemptEvents:
    """The attempt with this index, from 1; `chance` keys its noise and perturbation.

    While a person steers, theirs is the action and the horizon stands still; afterwards the policy plans anew and its
    motion fades in."""
    robot, planner, detector = setting.robot, setting.planner, setting.detector
    alarm, person, horizon = setting.alarm, setting.person, setting.task.horizon
    stretch = setting.stretch if index == 1 else 1
    shares = np.array((stretch,) * ARM_DIMS + (1,))  # the gripper is told the whole of its action in every part
    perturbation = method.perturb(index, chance)
    steps: list[Step] = []
    step: Step | None = None
    helped, since = 0, FADE_IN  # ticks a person acted, ticks the policy has had the arm again
    detector.begin()
    alarm.begin()
    planner.begin(method.policy)
    motion = Motion(method.policy.spec, setting.scale, robot.observe().eef)

    for t in itertools.count():
        deadline = yield Tick(phase="attempt", attempt_index=index, step=steps[-1] if steps else None)
        assert isinstance(deadline, float), "a Tick is answered with its deadline"
        observation = robot.observe()
        if step is not None:
            steps.append(completed(step, observation, motion.integrator, shares))
        if isinstance(deadline, AfterHold):
            motion.restart(observation.eef)

        outcome = detector.judge(observation) or fault(observation)
        if outcome is None and not person.steers:
            outcome = alarm.judge(motion.plan, t)
            if outcome is None and t - helped == horizon and detector.patience > 0:
                outcome = yield from wait_for_word(robot, detector, index, person)
                if person.steers:  # the arm was held: on from where it stands
                    observation = robot.observe()
                    motion.go_on_from(observation.eef)
        if outcome is not None or helped == HELP_LIMIT or (t - helped == horizon and not person.steers):
            break

        for chunk in (yield from planner.plan(motion.see(observation), t, (chance, index, t))):
            motion.plan.add(chunk)
            if chunk.tick < len(steps):  # V(s_k) of an earlier tick, computed in time for the record
                steps[chunk.tick] = replace(steps[chunk.tick], value=chunk.value)
        asked = person.action(observation)
        if asked is None and step is not None and step.intervention:  # handed back: older plans are void
            motion.plan, since = motion.plan.newest(), 0
            alarm.begin()
        action = asked if asked is not None else motion.plan.action(t)  # â_t = g(chunks)
        delta = perturbation(t) if asked is None and action is not None else np.zeros(ACTION_DIM)  # δ_t
        commanded = np.clip(action + delta, -1.0, 1.0) if action is not None else hold_still(steps)
        if asked is not None:
            helped += 1
        elif since < FADE_IN:
            since += 1
            commanded = commanded * np.array((since / FADE_IN,) * ARM_DIMS + (1.0,))

        part = commanded / shares
        measured, deadline = yield from lead_up(setting, motion, part, observation, deadline, index, stretch - 1)
        target = motion.integrator.target(part, measured, deadline)
        robot.send(target)
        step = Step(
            tick=t, seq=target.seq, stamp=observation.stamp, deadline=deadline, observation=observation,
            action=action if action is not None else commanded, perturbation=delta, commanded=commanded,
            sent=np.full(ACTION_DIM, np.nan), chunk_tick=motion.plan.newest_tick, starved=action is None,
            policy_version=method.policy.version, value=motion.plan.value(t), reward=observation.reward,
            success=observation.success, intervention=asked is not None,
        )  # fmt: skip

    return Attempt(
        index=index, scene_seed=scene_seed, steps=tuple(steps), final=observation,
        outcome=outcome or Outcome(success=False, judged_by=Judge.HORIZON), policy_version=method.policy.version,
    )  # fmt: skip


def lead_up(
    setting: Setting,
    motion: Motion,
    part: Float[np.ndarray, "A"],
    seen: Observation,
    deadline: float,
    index: int,
    parts: int,
) -> Generator[Event, Answer, tuple[Pose, float]]:
    """At reduced speed: the parts of an action before its last one, a tick each. Returns the measured pose and the
    deadline that the last part has."""
    for _ in range(parts):
        setting.robot.send(motion.integrator.target(part, seen.eef, deadline))
        answer = yield Tick(phase="attempt", attempt_index=index, between=True)
        assert isinstance(answer, float), "a Tick is answered with its deadline"
        deadline, seen = answer, setting.robot.observe()
        for ack in seen.acks:
            motion.integrator.executed(ack)
        if isinstance(deadline, AfterHold):
            motion.restart(seen.eef)
    return seen.eef, deadline


def wait_for_word(
    robot: Robot, detector: SuccessDetector, index: int, person: Person
) -> Generator[Event, Answer, Outcome | None]:
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


def hold_still(steps: list[Step]) -> Float[np.ndarray, "A"]:
    """No plan left: no motion, the gripper as it was."""
    action = np.zeros(ACTION_DIM)
    action[6] = steps[-1].commanded[6] if steps else -1.0
    return action
