"""Policy versions of a running session: undo, restore, keep; each refused with a reason where it does nothing."""

from __future__ import annotations

import time

import numpy as np
import pytest

from far_app.lineage import BASE, PolicyRow, VersionWish, Wish, ancestry
from far_app.recording.reader import read_session
from far_app.recording.schema import SessionInfo
from far_app.recording.writer import SessionWriter
from far_app.session_states import Intent, State
from far_app.types import AdaptedWeights
from tests.session.kinematic import Faster, Forward
from tests.session.test_session import Desk


class Keeping(Faster):
    """A method whose weights are the speed of its policy."""

    def __init__(self, policy, adapting_seconds=0.0) -> None:
        super().__init__(policy, adapting_seconds)
        policy.version = BASE
        self._first, self.adapted, self._made, self.used = policy, None, 0, []

    def begin(self, scene_seed) -> None:
        super().begin(scene_seed)
        self._made = 0

    def adapt(self, attempt, cancelled, progress):
        parent = self.policy.version
        told = super().adapt(attempt, cancelled, progress)
        if told.status != "adapted":
            return told
        self._made += 1
        self.policy.version = f"base+a{self._made}"
        tensors = {"speed": np.array([self.policy.speed], np.float32)}
        self.adapted = AdaptedWeights(version=self.policy.version, parent=parent, base="first", tensors=tensors)
        return type(told)(**{**vars(told), "version": self.policy.version})

    def use(self, weights, version, *, base) -> None:
        self.used.append((version, base))
        if weights is None:
            self.policy = self._first
        else:
            self.policy = Forward(float(weights.tensors["speed"][0]))
            self.policy.version = version
        if base:
            self._base = self.policy


def desk(attempts=3, trials=1, adapting_seconds=0.0, **settings) -> Desk:
    method = Keeping(Forward(speed=0.02), adapting_seconds)
    made = Desk(horizon=8, attempts=attempts, trials=trials, headless=False, method=method, **settings)
    made.acted, before = [], made.session.driver._attempt_ended

    def ended(event):
        made.acted.append((made.session.board.trial, event.attempt.index, event.attempt.policy_version))
        before(event)

    made.session.driver._attempt_ended = ended
    return made


def wish(d: Desk, kind: Wish, version: str = "") -> None:
    d.inbox.say(VersionWish(wish=kind, version=version, by="ada"))


def in_attempt(d: Desk, trial: int, attempt: int):
    board = d.session.board
    return lambda: (board.trial, board.attempt) == (trial, attempt) and d.state is State.RUNNING


def test_an_adaptation_that_is_undone_while_it_runs_does_not_act():
    d = desk(attempts=2, adapting_seconds=0.3)
    d.when(lambda: d.state is State.ADAPTING, lambda: wish(d, Wish.UNDO))
    d.session.run()
    assert [version for _, _, version in d.acted] == ["base", "base"]
    assert [row.name for row in d.session.versions.told().rows] == [BASE, "1:base+a1"], "it stays in the lineage"


def test_undo_during_a_retry_brings_back_its_parent_for_the_next_attempt():
    d = desk(attempts=3)
    d.when(in_attempt(d, 1, 2), lambda: wish(d, Wish.UNDO))
    d.session.run()
    assert [version for _, _, version in d.acted] == ["base", "base+a1", "base"]
    rows = {row.name: row for row in d.session.versions.told().rows}
    assert rows["1:base+a1"].acted == 1 and rows[BASE].acted == 2


def test_any_earlier_version_can_be_restored_in_a_later_trial():
    d = desk(attempts=2, trials=2)
    d.when(in_attempt(d, 2, 1), lambda: wish(d, Wish.RESTORE, "1:base+a1"))
    d.session.run()
    assert d.acted[-1] == (2, 2, "1:base+a1")


def test_a_kept_version_is_where_coming_trials_begin_and_what_they_learn_from_it_says_so():
    d = desk(attempts=2, trials=3)
    d.when(in_attempt(d, 2, 1), lambda: wish(d, Wish.KEEP, "1:base+a1"))
    d.session.run()
    assert [v for t, a, v in d.acted if a == 1] == ["base", "base", "1:base+a1"]
    told = d.session.versions.told()
    assert told.base == "1:base+a1"
    assert ancestry(told.rows, "3:base+a1") == ("3:base+a1", "1:base+a1", BASE)


def test_old_weights_are_read_from_the_recording(tmp_path, monkeypatch):
    monkeypatch.setattr("far_app.session.versions.LIMIT", 0)
    writer = SessionWriter(tmp_path, SessionInfo(task="lift", method="test"))
    d = desk(attempts=3, trials=2, writer=writer)

    def later():
        deadline = time.monotonic() + 5
        while not (writer.folder / "trial_0001/attempt_1.weights.safetensors").exists():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        wish(d, Wish.RESTORE, "1:base+a1")

    d.when(in_attempt(d, 2, 1), later)
    d.session.run()
    assert "1:base+a1" not in d.session.versions._weights and (2, 2, "1:base+a1") in d.acted
    told = [e for e in read_session(writer.folder).log if e.event == "policy_restored"]
    assert [e.detail for e in told] == [{"version": "1:base+a1", "by": "ada"}]


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        (VersionWish(wish=Wish.UNDO), "undoes nothing"),
        (VersionWish(wish=Wish.RESTORE, version="9:base+a9"), "no version"),
        (VersionWish(wish=Wish.KEEP, version=BASE), "already"),
    ],
)
def test_a_wish_that_does_nothing_is_refused_with_a_reason(asked, why):
    d = desk(attempts=1)
    d.when(in_attempt(d, 1, 1), lambda: (d.inbox.say(asked), time.sleep(0.1), d.inbox.put(Intent.MARK_SUCCESS)))
    d.session.run()
    assert any(why in line.text and line.level == "warning" for line in d.session.board._log)
    assert d.method.used == []


def test_a_method_without_weights_says_that_there_is_nothing_to_choose():
    d = Desk(horizon=8, attempts=1)
    assert "no weights" in d.session.versions.told().unavailable
    assert "no weights" in d.session.versions.refusal(VersionWish(wish=Wish.UNDO))


def test_a_lineage_ends_at_the_base_and_never_runs_in_circles():
    rows = (PolicyRow(name=BASE, parent=""), PolicyRow(name="a", parent="b"), PolicyRow(name="b", parent="a"))
    assert ancestry(rows, BASE) == (BASE,)
    assert ancestry(rows, "a") == ("a", "b")
