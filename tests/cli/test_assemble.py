"""Putting a method together: what a model's own files decide."""

import math

import pytest

from far_app.cli.assemble import shipped, with_threshold
from far_app.config import AttributionConfig, RetryConfig

BY_THRESHOLD = RetryConfig(attribution=AttributionConfig(rule="threshold"))


def test_a_threshold_that_is_not_given_is_the_models_own():
    found = with_threshold(BY_THRESHOLD, shipped("lift", "critic"))
    assert math.isfinite(found.attribution.threshold)


@pytest.mark.parametrize("rule", [AttributionConfig(), AttributionConfig(rule="threshold", threshold=-1.5)])
def test_what_was_given_stays(rule):
    settings = RetryConfig(attribution=rule)
    assert with_threshold(settings, shipped("lift", "critic")) is settings
