"""The timeline of the ticks: every stage's time is its own, complete when handed out, and the newest are kept."""

import time

import numpy as np
import pytest

from far_app.recording.reader import read_session
from far_app.recording.schema import SessionInfo
from far_app.recording.writer import SessionWriter
from far_app.session import timeline as stages
from far_app.session.timeline import SETTLED, Timeline
from far_app.session_states import Intent
from far_app.types import TICK_STAGES, Ack
from tests.session.kinematic import HOME, Forward
from tests.session.test_session import Desk


class Clock:
    """Moves by what the test says."""

    def __init__(self, monkeypatch) -> None:
        self.now = 10**9
        monkeypatch.setattr(stages.time, "perf_counter_ns", lambda: self.now)

    def passes(self, microseconds: int) -> None:
        self.now += 1000 * microseconds


@pytest.fixture
def clock(monkeypatch) -> Clock:
    return Clock(monkeypatch)


def tick(timeline: Timeline, clock: Clock, number: int, scale: int = 1) -> None:
    """A tick whose stages take 10, 20, 30, 40, 50 µs times the scale; sending stands within aggregating."""
    timeline.begin(number, number / 30)
    clock.passes(10 * scale)
    timeline.lap(stages.OBSERVE)
    clock.passes(5 * scale)
    began = clock.now
    clock.passes(30 * scale)
    timeline.within(stages.SEND, began)
    timeline.sent(100 + number)
    clock.passes(15 * scale)
    timeline.lap(stages.AGGREGATE)
    clock.passes(40 * scale)
    timeline.lap(stages.RECORD)
    clock.passes(50 * scale)
    timeline.lap(stages.PUBLISH)
    clock.passes(7_000)  # sleeping until the next deadline is nobody's


def ack(seq: int, seconds: float) -> Ack:
    return Ack(seq=seq, accepted=0.0, due=0.0, pose=HOME, gripper=1.0, filter_seconds=seconds)


def test_what_happens_within_a_stage_is_not_counted_twice(clock):
    timeline = Timeline()
    tick(timeline, clock, 0)
    (times,) = timeline.settled(all_of_them=True)
    microseconds = {stage: round(1e6 * getattr(times, stage)) for stage in TICK_STAGES}
    assert microseconds == {
        "observe": 10,
        "infer": 0,
        "aggregate": 20,
        "filter": 0,
        "send": 30,
        "record": 40,
        "publish": 50,
    }


def test_the_filters_time_reaches_the_tick_whose_target_it_was(clock):
    timeline = Timeline()
    for number in range(6):
        tick(timeline, clock, number)
        timeline.elsewhere(stages.INFER, 2_000_000 * (number == 4))
        if number >= 2:
            timeline.acknowledged(ack(100 + number - 2, 1e-4 * (number - 1)))
    timeline.acknowledged(ack(999, 1.0))
    timeline.acknowledged(ack(105, float("nan")))
    times = timeline.settled(all_of_them=True)
    assert [round(1e4 * t.filter) for t in times] == [1, 2, 3, 4, 0, 0]
    assert [t.infer for t in times] == [0, 0, 0, 0, 0.002, 0]


def test_a_tick_is_handed_out_once_and_only_when_it_is_complete(clock):
    timeline, handed = Timeline(), []
    for number in [-1, -1, *range(8), -1]:  # homing, an attempt, homing
        tick(timeline, clock, number)
        handed += [t.tick for t in timeline.settled()]
        assert len(handed) <= max(0, timeline.ticks - 2 - SETTLED)
    handed += [t.tick for t in timeline.settled(all_of_them=True)]
    assert handed == list(range(8))
    assert timeline.settled(all_of_them=True) == []


def test_a_hold_is_no_work_of_its_tick(clock):
    timeline = Timeline()
    timeline.begin(0, 0.0)
    clock.passes(3_000_000)
    timeline.restart()
    clock.passes(10)
    timeline.lap(stages.OBSERVE)
    (times,) = timeline.settled(all_of_them=True)
    assert times.observe == pytest.approx(10e-6)


def test_the_newest_ticks_are_kept_when_the_arrays_are_full(clock):
    timeline = Timeline(capacity=8)
    for number in range(21):
        tick(timeline, clock, number, scale=number + 1)
    shown = timeline.recent(300)
    assert shown.shape == (7, len(TICK_STAGES)) and shown.dtype == np.float32, "the tick under way is not shown"
    assert shown[:, stages.OBSERVE] == pytest.approx([0.01 * (n + 1) for n in range(13, 20)])
    assert [t.tick for t in timeline.settled(all_of_them=True)] == list(range(13, 21))
    timeline.acknowledged(ack(100, 1.0))
    assert not timeline.recent(300)[:, stages.FILTER].any(), "a row that was overwritten is another tick's"


def test_percentiles_are_of_the_attempts_ticks_alone(clock):
    timeline = Timeline()
    for number in (-1, 0, 1, 2, -1, -1):
        tick(timeline, clock, number, scale=1 if number >= 0 else 100)
    timeline.acknowledged(ack(101, 0.0004))
    found = timeline.percentiles()
    assert found["record"] == {"p50": 0.04, "p99": 0.04, "mean": 0.04}
    assert found["filter"]["p50"] == 0.4, "over the ticks that have one"
    assert found["infer"] == {"p50": None, "p99": None, "mean": None}


def test_a_session_records_the_times_of_every_tick_of_its_attempts(tmp_path):
    writer = SessionWriter(tmp_path, SessionInfo(task="lift", method="nr"), space_to_start=0, space_to_go_on=0)
    desk = Desk(policy=Forward(speed=0.1, seconds=0.002), attempts=2, horizon=15, writer=writer)
    desk.session.run()
    for attempt in read_session(writer.folder).attempts():
        ticks = [t.tick for t in attempt.tick_times]
        assert ticks == list(range(len(attempt.steps) + 1)), "one more than steps: the last tick only judges"
        assert [t.stamp for t in attempt.tick_times[:-1]] == [s.deadline for s in attempt.steps]
        assert sum(t.infer > 0.001 for t in attempt.tick_times) >= 5
        assert all(min(t.observe, t.aggregate, t.record, t.publish) > 0 for t in attempt.tick_times[:-1])
        assert all(t.send > 0 for t in attempt.tick_times[:-1])


def test_a_pause_does_not_count_as_a_tick_that_took_long():
    desk = Desk(policy=Forward(speed=0.05), headless=False, attempts=1, horizon=40)

    def pause():
        desk.inbox.put(Intent.PAUSE)
        time.sleep(0.5)
        desk.inbox.put(Intent.RESUME)

    desk.when(desk.moving, pause)
    desk.session.run()
    assert desk.statistics.timeline.recent(1000)[:, stages.OBSERVE].max() < 400


def test_the_page_is_told_the_last_ten_seconds():
    desk = Desk(attempts=1)
    desk.session.run()
    told = desk.statistics.health().stages
    assert told.shape == (desk.statistics.timeline.ticks - 1, len(TICK_STAGES))
    assert (told[:, stages.OBSERVE] > 0).all()
