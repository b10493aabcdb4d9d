"""A demonstration by a person who leads the arm with his hands: nothing commands it, its own motion is recorded.

    a_t = (pose_t → pose_{t+1}) as an action of the rig's scale          the gripper: as the person asked for it

One trial of one attempt, with the events of far_app/events.py, so that the session drives, records and judges it like
any other. The arm is made compliant by a Guide request and stiff again at the end, whatever ends it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from far_app.attempt import HELP_LIMIT, Setting, fault
from far_app.events import AfterHold, AttemptEnded, AttemptEvents, AttemptStarted, Tick, TrialEvents
from far_app.motion import ActionScale, action_between
from far_app.protocols import Guide, Heartbeat, Reset
from far_app.trial import go_home
from far_app.types import Attempt, Judge, Observation, Outcome, Step, Trial

VERSION = "a person"
"""In place of a policy's version."""


def guided_trial(scene_seed: int, setting: Setting) -> TrialEvents:
    """Home, then the person's hands until somebody judges. Raises RobotError where the arm cannot be led by hand."""
    setting.robot.request(Reset(seed=scene_seed))
    yield from go_home(setting.robot, attempt_index=1)
    yield AttemptStarted(attempt_index=1, policy_version=VERSION)
    attempt = yield from led(setting, scene_seed)
    yield AttemptEnded(attempt=attempt, last=True)
    return Trial(scene_seed=scene_seed, attempts=(attempt,), adaptations=())


def led(setting: Setting, scene_seed: int) -> AttemptEvents:
    """One attempt. A tick: observe → what the last tick's motion was → judge."""
    robot, detector, scale, person = setting.robot, setting.detector, setting.scale, setting.person
    steps: list[Step] = []
    detector.begin()
    leading = False
    gripper = -1.0
    for t in range(HELP_LIMIT + 1):
        deadline = yield Tick(phase="attempt", attempt_index=1, step=steps[-1] if steps else None)
        assert isinstance(deadline, float), "a Tick is answered with its deadline"
        observation = robot.observe()
        if steps:
            steps[-1] = moved(steps[-1], observation, scale)
        outcome = detector.judge(observation) or fault(observation)
        if outcome is not None or t == HELP_LIMIT:
            break
        if isinstance(deadline, AfterHold):
            leading = False
        asked = person.action(observation)  # its gripper; None while the operator has paused
        if asked is not None:
            if not leading or asked[6] != gripper:
                gripper = float(asked[6])
                robot.request(Guide(on=True, gripper=gripper))
            robot.request(Heartbeat())
        leading = asked is not None
        still = np.append(np.zeros(6), gripper)
        steps.append(
            Step(
                tick=t, seq=-1, stamp=observation.stamp, deadline=deadline, observation=observation, action=still,
                perturbation=np.zeros(7), commanded=still, sent=still, chunk_tick=-1, starved=False,
                policy_version=VERSION, value=float("nan"), reward=observation.reward, success=observation.success,
                intervention=True,
            )
        )  # fmt: skip
    robot.request(Guide(on=False))
    return Attempt(
        index=1, scene_seed=scene_seed, steps=tuple(steps), final=observation,
        outcome=outcome or Outcome(success=False, judged_by=Judge.HORIZON), policy_version=VERSION,
    )  # fmt: skip


def moved(step: Step, after: Observation, scale: ActionScale) -> Step:
    """The step with the action that its tick's motion amounts to. What was faster than an action can say stays beyond
    ±1 in `sent`; `commanded` is cut to what a policy could ask for."""
    action = action_between(step.observation.eef, after.eef, float(step.commanded[6]), scale)
    return replace(step, action=np.clip(action, -1.0, 1.0), commanded=np.clip(action, -1.0, 1.0), sent=action)
