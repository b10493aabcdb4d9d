"""Intervals and tests against published or hand-computed values."""

import pytest

from far_app.statistics import comparison, costs, mcnemar, paired_difference, solved_within, wilson


def test_wilson_of_a_known_case():
    assert wilson(8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert wilson(0, 10)[0] == 0.0
    assert wilson(10, 10)[1] == 1.0


def test_mcnemar_is_the_two_sided_binomial():
    assert mcnemar(0, 0) == 1.0
    assert mcnemar(1, 5) == pytest.approx(2 * (1 + 6) / 64)
    assert mcnemar(5, 1) == mcnemar(1, 5)


def test_paired_difference_uses_the_pairs():
    mean, low, high = paired_difference([True, True, False, False], [True, False, False, False])
    assert mean == 0.25
    assert low < 0.25 < high


def test_success_counts_only_within_the_allowed_attempts():
    record = {"success": True, "attempts": 3}
    assert not solved_within(record, 2)
    assert solved_within(record, 3)


def test_only_scenes_that_every_method_has_are_compared():
    records = [{"arm": a, "scene": s, "success": s % 2 == 0, "attempts": 1} for a in ("nr", "far") for s in range(4)]
    table = comparison(records[:-1], ["nr", "far"], 2)
    assert table.startswith("3 scenes")


def test_costs_are_means_over_scenes():
    records = [
        {"arm": "far", "attempts": 2, "ticks": [150, 60], "adaptations": [{"status": "adapted", "seconds": 4.0}]},
        {"arm": "far", "attempts": 1, "ticks": [70], "adaptations": []},
    ]
    assert costs(records) == ("1.50", "140", "0.50", "4.0")
    assert costs([]) == ("–", "–", "–", "–")
