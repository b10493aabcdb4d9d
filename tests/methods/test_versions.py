"""Adapted weights kept, undone, restored and begun with."""

import copy
import dataclasses

import numpy as np
import pytest
import torch

from far_app.errors import FarError
from tests.learning.small import small_attempt, small_policy
from tests.methods.making import QUICK, adapt, made, plan


def test_an_undone_lesson_leaves_no_trace_and_a_restored_one_is_the_same():
    m = made("far")
    m.begin(5)
    base = plan(m)
    adapt(m)
    first, lesson = m.adapted, plan(m)
    adapt(m, small_attempt(index=2))
    assert m.policy.version == "base+a2"
    m.use(first, "1:base+a1", base=False)
    assert m.policy.version == "1:base+a1" and np.array_equal(plan(m), lesson)
    again = adapt(m, small_attempt(index=2))
    assert again.version == "base+a3" and m.adapted.parent == "1:base+a1", "later lessons build on it"
    m.use(None, "base", base=False)
    assert m.policy.version == "base" and np.array_equal(plan(m), base)


def test_lessons_that_restart_forget_the_pairs_of_an_undone_one():
    config = dataclasses.replace(QUICK, fcpa=dataclasses.replace(QUICK.fcpa, accumulate=False))
    m = made("far", config)
    m.begin(5)
    adapt(m)
    first = m.adapted
    adapt(m, small_attempt(index=2))
    assert len(m.rounds) == 2
    m.use(first, "1:base+a1", base=False)
    assert len(m.rounds) == 1
    m.use(None, "base", base=False)
    assert m.rounds == []


def test_a_kept_version_begins_the_coming_trials_and_the_first_base_is_still_there():
    network = small_policy()
    weights = copy.deepcopy(network.state_dict())
    m = made("far", network=network)
    m.begin(5)
    base = plan(m)
    adapt(m)
    kept, lesson = m.adapted, plan(m)
    m.use(kept, "1:base+a1", base=True)
    m.begin(6)
    assert m.policy.version == "1:base+a1" and np.array_equal(plan(m), lesson)
    adapt(m, small_attempt(index=1))
    assert m.adapted.parent == "1:base+a1" and m.adapted.base == kept.base
    m.use(None, "base", base=True)
    m.begin(7)
    assert np.array_equal(plan(m), base)
    assert all(torch.equal(v, weights[k]) for k, v in network.state_dict().items()), "the base is never written to"


def test_weights_of_another_policy_are_refused_and_change_nothing():
    m = made("far")
    m.begin(5)
    adapt(m)
    version = m.policy.version
    with pytest.raises(FarError, match="fingerprint"):
        m.use(dataclasses.replace(m.adapted, base="another"), "1:base+a1", base=False)
    with pytest.raises(FarError, match="do not fit"):
        m.use(dataclasses.replace(m.adapted, tensors={"nothing": np.zeros(1)}), "1:base+a1", base=False)
    assert m.policy.version == version
