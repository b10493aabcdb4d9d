"""Trials side by side end as they end alone."""

from dataclasses import replace

import numpy as np

from far_app.detectors import TwinCheck
from far_app.errors import RobotError
from far_app.motion import ActionScale
from far_app.session.lockstep import adapt_at_once, run_lockstep, run_together
from far_app.session.planners import LockstepPlanner
from far_app.tasks import task
from far_app.trial import trial
from far_app.types import Trial
from tests.session.kinematic import Faster, Forward, KinematicRobot

TASK = replace(task("lift"), horizon=20, max_attempts=3)


def begun(scene: int, lane: int = 0):
    """Scene n is solved at speed 0.1 (n + 1): some at once, some after lessons, some never."""
    clock = iter(range(10**6))
    events = trial(
        scene, KinematicRobot(), LockstepPlanner(), Faster(Forward(speed=0.1 * (scene + 1))), TwinCheck(2), TASK,
        ActionScale(), adapt_at_once,
    )  # fmt: skip
    return events, lambda: 1000.0 + next(clock) / 30


def failed(scene, lane, error) -> Trial:
    return Trial(scene_seed=scene, attempts=tuple(lane.attempts), adaptations=tuple(lane.adaptations))


def of(jobs):
    waiting = iter(jobs)
    return lambda: next(waiting, None)


def facts(result: Trial):
    return [(a.outcome.success, len(a.steps), [s.commanded.tolist() for s in a.steps]) for a in result.attempts]


def test_every_trial_ends_as_it_would_alone():
    together = dict(run_together(of(range(5)), 3, begun, failed))
    assert sorted(together) == list(range(5))
    for scene, result in together.items():
        assert facts(result) == facts(run_lockstep(*begun(scene)))


def test_a_robot_that_gives_up_ends_its_own_trial_only():
    def start(scene: int, lane: int):
        events, advance = begun(scene, lane)
        if scene != 1:
            return events, advance
        calls = iter(range(25))

        def tired() -> float:
            if next(calls, None) is None:
                raise RobotError("the arm does not want to")
            return advance()

        return events, tired

    together = dict(run_together(of(range(3)), 2, start, failed))
    assert not together[1].success and len(together[1].attempts) < 3
    assert np.all([facts(together[s]) == facts(run_lockstep(*begun(s))) for s in (0, 2)])


def test_an_end_may_bring_more_jobs():
    jobs = [0, 1]
    ended = []
    for scene, _ in run_together(lambda jobs=jobs: jobs.pop(0) if jobs else None, 2, begun, failed):
        ended.append(scene)
        if scene == 1:
            jobs += [3, 4]
    assert sorted(ended) == [0, 1, 3, 4]
