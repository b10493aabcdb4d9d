"""Pictures arrive just before the tick that uses them, whatever the two clocks' phase and drift."""

from __future__ import annotations

import numpy as np
import pytest

from hw.picture_timing import PictureTiming

SERVO, POLICY = 1 / 120, 1 / 30


def ages(offset: float, drift: float, drawing: float, jitter: float, steered: bool, seconds: float = 60) -> np.ndarray:
    """Age at each of the app's ticks of the newest pictures, seconds: snapshot, drawing, publication, tick."""
    rng = np.random.default_rng(0)
    timing = PictureTiming(SERVO, POLICY)
    servo_tick, next_picture = 0, 0
    pictures = [(-1.0, -1.0)]  # taken, published
    result = []
    for tick in range(1, int(seconds / POLICY)):
        due = tick * POLICY
        while offset + servo_tick * SERVO * (1 + drift) < due:
            if servo_tick >= next_picture:
                taken = offset + servo_tick * SERVO * (1 + drift)
                pictures.append((taken, taken + drawing + rng.exponential(jitter)))
                next_picture = servo_tick + 4
            servo_tick += 1
        taken, published = max(p for p in pictures[-6:] if p[1] <= due)
        result.append(due - taken)
        if steered:
            next_picture += timing.shift(due - published)
    return np.array(result[len(result) // 3 :])


@pytest.mark.parametrize("offset", [0.0, 0.003, 0.009, 0.014, 0.020, 0.026, 0.031])
@pytest.mark.parametrize("drift", [0.0, 1e-4, -1e-4])
def test_the_policy_sees_pictures_as_young_as_drawing_allows(offset: float, drift: float) -> None:
    drawing, jitter = 0.009, 0.001
    steered = ages(offset, drift, drawing, jitter, steered=True)
    assert np.median(steered) < drawing + jitter + 0.003 + SERVO + 0.002
    assert np.mean(steered > POLICY + drawing) < 0.05, "hardly a tick misses its pictures"


def test_without_it_the_age_is_left_to_chance() -> None:
    worst = max(np.median(ages(offset, 0.0, 0.009, 0.001, steered=False)) for offset in (0.0, 0.009, 0.02, 0.026))
    assert worst > 0.03
