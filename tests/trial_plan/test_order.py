"""The order of a plan's trials, and its letters: random, from the seed alone, and fair to every method."""

from __future__ import annotations

from dataclasses import replace

from far_app.trial_plan.order import letters, slots
from far_app.trial_plan.plan import PlannedMethod
from tests.trial_plan.plans import plan


def test_every_trial_once_and_the_same_order_for_the_same_seed():
    ab = plan(repetitions=4)
    order = slots(ab)
    assert len(order) == len(set(order)) == ab.trials == 24
    assert slots(ab) == order
    assert any(slots(replace(ab, seed=seed)) != order for seed in range(1, 5))


def test_a_scene_meets_every_method_before_the_next_scene_comes():
    order = slots(plan(repetitions=10))
    for first, second in zip(order[::2], order[1::2], strict=True):
        assert (first.scene, first.repetition) == (second.scene, second.repetition)
        assert {first.method, second.method} == {"ours", "theirs"}
    assert {s.method for s in order[::2]} == {"ours", "theirs"}, "either may come first"
    assert [s.repetition for s in order] == sorted(s.repetition for s in order)


def test_more_repetitions_leave_the_earlier_trials_where_they_were():
    assert slots(plan(repetitions=5))[:12] == slots(plan(repetitions=2))


def test_letters_do_not_tell_the_files_order():
    drawn = [letters(plan(seed=seed)) for seed in range(20)]
    assert all(sorted(found.values()) == ["A", "B"] for found in drawn)
    assert {found["ours"] for found in drawn} == {"A", "B"}
    many = plan(methods=tuple(PlannedMethod(name=str(n), method="nr") for n in range(30)))
    assert len(set(letters(many).values())) == 30
