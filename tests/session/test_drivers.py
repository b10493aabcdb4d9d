"""Clock, planners, background adaptation, lockstep driver: each by its law."""

from __future__ import annotations

import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from far_app.attempt import Setting
from far_app.detectors import TwinCheck
from far_app.errors import PolicyError
from far_app.motion import ActionScale
from far_app.noise import keyed_noise
from far_app.protocols import Planner, PlanRequest
from far_app.session.adaptation import BackgroundAdaptation
from far_app.session.clock import LEAST, MOST, ON_THE_WAY, TickClock
from far_app.session.lockstep import adapt_at_once, run_lockstep
from far_app.session.planners import LockstepPlanner, ThreadedPlanner
from far_app.tasks import task
from far_app.trial import trial
from tests.session.kinematic import Faster, Forward, KinematicRobot


class FakeTime:
    def __init__(self, monkeypatch) -> None:
        self.now = 100.0
        monkeypatch.setattr("far_app.session.clock.time.monotonic", lambda: self.now)
        monkeypatch.setattr("far_app.session.clock.time.sleep", self.sleep)

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def test_deadlines_lie_on_one_grid_whatever_a_tick_costs(monkeypatch):
    fake = FakeTime(monkeypatch)
    clock = TickClock(rate=10.0)
    clock.restart()
    deadlines = []
    for cost in (0.02, 0.09, 0.15, 0.01, 0.05):
        deadlines.append(clock.wait())
        fake.now += cost
    assert np.allclose(np.diff(deadlines), 0.1)
    assert clock.stalls == 0


def test_work_begins_as_early_as_the_slowest_tick_lately_needed_so_that_targets_are_there_in_time(monkeypatch):
    fake = FakeTime(monkeypatch)
    clock = TickClock(rate=30.0)
    clock.restart()
    clock.sent()
    assert clock.lead == LEAST, "nothing was waited for, nothing is learnt"
    spent = np.random.default_rng(0).exponential(0.001, 20_000) + 0.0003
    late, leads = [], []
    for took in spent:
        due = clock.wait()
        assert fake.now == pytest.approx(due - clock.lead, abs=1e-9)
        fake.now += took
        late.append(fake.now + ON_THE_WAY - due)
        clock.sent()
        leads.append(clock.lead)
        fake.now += 0.002
    assert np.percentile(late, 99) < 0.0 < np.percentile(spent, 99) + ON_THE_WAY - LEAST
    assert np.percentile(late, 99.9) < 0.0015, "with the least lead it would be 6 ms"
    assert max(leads) == MOST, "one that took longer is late, and the next do not pay for it with older observations"
    for _ in range(20_000):
        clock.wait()
        clock.sent()
    assert clock.lead == pytest.approx(LEAST, abs=1e-6), "what is long past is forgotten"


def test_targets_for_another_machine_leave_earlier_by_their_way_there(monkeypatch):
    fake, robot = FakeTime(monkeypatch), SimpleNamespace(on_the_way=0.0)
    clock = TickClock(rate=30.0, robot=robot)
    clock.restart()
    for way in (0.0, 0.0057, 0.0057, 0.009, 0.009):
        robot.on_the_way = way
        due = clock.wait()
        fake.now += 0.0004
        clock.sent()
    assert fake.now + way <= due
    assert clock.lead == pytest.approx(LEAST + way - ON_THE_WAY)
    robot.on_the_way = 3.0
    clock.wait()
    clock.sent()
    assert clock.lead <= LEAST + clock.period / 2, "it does not look at observations of ticks ago"


def test_a_stall_is_counted_and_never_followed_by_a_burst(monkeypatch):
    fake = FakeTime(monkeypatch)
    clock = TickClock(rate=10.0)
    clock.restart()
    clock.wait()
    fake.now += 1.0
    missed = clock.wait()
    assert missed < fake.now - 0.1, "the missed deadline is told, so that the lateness is counted"
    begun = fake.now
    waits = [clock.wait() for _ in range(3)]
    assert clock.stalls == 1
    assert np.allclose(waits, begun + 0.1 * np.arange(1, 4))


def lockstep_trial(delay_ticks: int = 0, speed: float = 0.5):
    robot, policy = KinematicRobot(), Forward(speed=speed)
    clock = iter(range(10**6))
    now = time.monotonic()
    setting = Setting(
        robot=robot, planner=LockstepPlanner(delay_ticks), detector=TwinCheck(2),
        task=replace(task("lift"), horizon=20, max_attempts=3), scale=ActionScale(),
    )  # fmt: skip
    events = trial(7, Faster(policy), setting, adapt_at_once)
    result = run_lockstep(events, lambda: now + 1000 + next(clock) / 30)
    return result, policy


def test_lockstep_runs_the_same_trial_without_a_clock():
    result, policy = lockstep_trial()
    assert result.success and len(result.attempts) == 1
    assert all(s.chunk_tick == s.tick and not s.starved for s in result.attempts[0].steps)
    assert np.array_equal(policy.noises[3], keyed_noise((7, 1, 3), 8, 7))


def test_a_delayed_chunk_takes_effect_so_many_ticks_later():
    result, _ = lockstep_trial(delay_ticks=2)
    steps = result.attempts[0].steps
    assert [s.starved for s in steps[:3]] == [True, True, False]
    assert all(s.tick - s.chunk_tick == 2 for s in steps[2:])


def test_lockstep_failures_are_learnt_from_at_once():
    result, _ = lockstep_trial(speed=0.1)
    assert [a.policy_version for a in result.attempts] == ["forward-0", "forward-0+1", "forward-0+1+2"]
    assert [a.status for a in result.adaptations] == ["adapted", "adapted"]


def observed() -> PlanRequest:
    policy = Forward()
    newest = KinematicRobot().observe()
    return PlanRequest(history=(newest, newest), tick=0, noise_key=(1, 1, 0), policy=policy)


@pytest.fixture
def planner():
    planner = ThreadedPlanner()
    yield planner
    planner.close()


def ask(planner: ThreadedPlanner, request: PlanRequest, tick: int):
    """What a tick of the trial does: hand over, take what is ready; then the driver lets inference begin."""
    try:
        next(planner.plan(request.history, tick, (1, 1, tick)))
    except StopIteration as end:
        planner.go()
        return list(end.value)
    raise AssertionError("a threaded planner asks nobody")


def test_a_primed_chunk_is_there_at_the_first_tick(planner):
    assert isinstance(planner, Planner)
    request = observed()
    planner.prime(request)
    planner.begin(request.policy)
    assert [c.tick for c in ask(planner, request, 0)] == [0]


def test_only_the_newest_history_is_planned_from(planner):
    request = observed()
    request.policy.seconds = 0.05
    planner.begin(request.policy)
    ready = []
    for tick in range(60):
        ready += ask(planner, request, tick)
        time.sleep(0.005)
    ticks = [c.tick for c in ready]
    assert ticks == sorted(ticks) and 1 <= len(ticks) <= 30, "what it cannot keep up with is dropped"
    assert np.array_equal(request.policy.noises[ticks[0]], keyed_noise((1, 1, ticks[0]), 8, 7))


def test_a_new_attempt_forgets_chunks_still_being_made(planner):
    request = observed()
    request.policy.seconds = 0.1
    planner.begin(request.policy)
    ask(planner, request, 5)
    time.sleep(0.02)
    planner.begin(request.policy)
    time.sleep(0.2)
    assert ask(planner, request, 0) == []


def test_a_non_finite_chunk_is_a_failure_and_never_handed_out(planner):
    request = observed()
    request.policy.poison = 0
    planner.prime(request)
    assert isinstance(planner.failure, PolicyError) and "tick 0" in str(planner.failure)
    planner.begin(request.policy)
    assert ask(planner, request, 0) == []


def attempt():
    result, _ = lockstep_trial()
    return result.attempts[0]


def test_a_background_adaptation_never_raises_but_says_what_failed():
    class Broken(Faster):
        def adapt(self, attempt, cancelled, progress):
            raise ValueError("no such tensor")

    adaptation = BackgroundAdaptation(Broken(Forward()), attempt(), limit=5.0)
    while not adaptation.done():
        time.sleep(0.01)
    result = adaptation.result()
    assert result.status == "failed" and "no such tensor" in result.note and result.version == "forward-0"


def test_a_cancelled_adaptation_ends_between_two_batches():
    method = Faster(Forward(), adapting_seconds=30.0)
    adaptation = BackgroundAdaptation(method, attempt(), limit=60.0)
    adaptation.cancel(wait=True)
    assert not adaptation.running
    assert adaptation.result().status == "cancelled" and method.policy.version == "forward-0"


def test_a_value_that_came_with_a_later_tick_still_reaches_its_step():
    result, _ = lockstep_trial(delay_ticks=2)
    values = [s.value for s in result.attempts[0].steps]
    assert np.isfinite(values[:-2]).all() and np.isnan(values[-2:]).all()
