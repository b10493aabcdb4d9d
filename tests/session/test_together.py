"""Trials side by side end as they end alone."""

from dataclasses import replace

import numpy as np

from far_app.attempt import Setting
from far_app.detectors import TwinCheck
from far_app.errors import RobotError
from far_app.motion import ActionScale
from far_app.protocols import Home, Resume
from far_app.session.lockstep import MOST_RESCUES, Lane, adapt_at_once, run_lockstep, run_together
from far_app.session.planners import LockstepPlanner
from far_app.tasks import task
from far_app.trial import trial
from far_app.types import Judge, RobotMode, Trial
from tests.session.kinematic import Faster, Forward, KinematicRobot

TASK = replace(task("lift"), horizon=20, max_attempts=3)


def setting(robot: KinematicRobot) -> Setting:
    return Setting(
        robot=robot, planner=LockstepPlanner(), detector=TwinCheck(2), task=TASK, scale=ActionScale()
    )  # fmt: skip


def begun(scene: int, lane: int = 0):
    """Scene n is solved at speed 0.1 (n + 1): some at once, some after lessons, some never."""
    clock = iter(range(10**6))
    events = trial(scene, Faster(Forward(speed=0.1 * (scene + 1))), setting(KinematicRobot()), adapt_at_once)
    return Lane(events, lambda: 1000.0 + next(clock) / 30)


def failed(scene, lane, error) -> Trial:
    return Trial(
        scene_seed=scene, attempts=tuple(lane.attempts), adaptations=tuple(lane.adaptations), rescues=lane.rescues
    )


def alone(scene: int) -> Trial:
    lane = begun(scene)
    return run_lockstep(lane.events, lane.advance)


def of(jobs):
    waiting = iter(jobs)
    return lambda: next(waiting, None)


def facts(result: Trial):
    return [(a.outcome.success, len(a.steps), [s.commanded.tolist() for s in a.steps]) for a in result.attempts]


def test_every_trial_ends_as_it_would_alone():
    together = dict(run_together(of(range(5)), 3, begun, failed))
    assert sorted(together) == list(range(5))
    for scene, result in together.items():
        assert facts(result) == facts(alone(scene))


def test_a_robot_that_gives_up_ends_its_own_trial_only():
    def start(scene: int, lane: int):
        lane_ = begun(scene, lane)
        if scene != 1:
            return lane_
        calls = iter(range(25))

        def tired() -> float:
            if next(calls, None) is None:
                raise RobotError("the arm does not want to")
            return lane_.advance()

        return replace(lane_, advance=tired)

    together = dict(run_together(of(range(3)), 2, start, failed))
    assert not together[1].success and len(together[1].attempts) < 3
    assert np.all([facts(together[s]) == facts(alone(s)) for s in (0, 2)])


def test_an_end_may_bring_more_jobs():
    jobs = [0, 1]
    ended = []
    for scene, _ in run_together(lambda jobs=jobs: jobs.pop(0) if jobs else None, 2, begun, failed):
        ended.append(scene)
        if scene == 1:
            jobs += [3, 4]
    assert sorted(ended) == [0, 1, 3, 4]


def caught(every: int, times: int) -> Lane:
    """A goal out of reach, and an arm that latches every so many ticks, in an attempt or on its way home."""
    robot, ticks, left = KinematicRobot(goal=9.0, homing_ticks=5), iter(range(10**6)), iter(range(times))

    def advance() -> float:
        now = next(ticks)
        if now % every == every - 1 and next(left, None) is not None:
            robot.latch("caught in a door", fault=True)
        return 1000.0 + now / 30

    def free() -> bool:
        if robot.status.mode is not RobotMode.LATCHED:
            return False
        robot.request(Resume())
        robot.request(Home())
        return True

    events = trial(0, Faster(Forward(speed=0.1)), setting(robot), adapt_at_once)
    return Lane(events, advance, free)


def test_an_operator_frees_a_latched_arm_and_the_trial_goes_on():
    together = run_together(of([0]), 1, lambda scene, lane: caught(every=10, times=2), failed)
    ((_, result),) = together
    assert [a.outcome.judged_by for a in result.attempts] == [Judge.FAULT, Judge.FAULT, Judge.HORIZON]
    assert result.rescues == 2


def test_an_arm_that_latches_again_and_again_is_given_up():
    ((_, result),) = run_together(of([0]), 1, lambda scene, lane: caught(every=3, times=10**6), failed)
    assert not result.success and result.rescues == MOST_RESCUES + 1
