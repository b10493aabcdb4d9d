"""A policy's picture is a pure function of the frame: the same live and from a dataset."""

from __future__ import annotations

import numpy as np
import pytest

from far_app.errors import ConfigError
from far_app.picture import Framing, framed, seen

FRAME = np.random.default_rng(0).integers(0, 256, (72, 256, 3), np.uint8)


def test_a_picture_of_the_right_size_comes_back_unchanged_so_framing_twice_is_framing_once():
    once = seen(FRAME, Framing(eye="left"), 24)
    assert once.shape == (24, 24, 3) and once.dtype == np.uint8
    assert np.array_equal(seen(once, Framing(), 24), once)


def test_the_eyes_are_the_halves_and_a_turn_is_counter_clockwise():
    assert np.array_equal(framed(FRAME, Framing(eye="left", crop=(0, 0, 128, 72))), FRAME[:, :128])
    assert np.array_equal(framed(FRAME, Framing(eye="right", crop=(0, 0, 128, 72))), FRAME[:, 128:])
    turned = framed(FRAME, Framing(rotate=90, crop=(0, 0, 72, 256)))
    assert np.array_equal(turned[0, 0], FRAME[0, -1]), "the right upper corner comes to the left"


def test_without_a_crop_it_is_the_largest_square_in_the_middle():
    assert np.array_equal(framed(FRAME, Framing(eye="left")), FRAME[:, 28:100])


def test_shrinking_averages_areas_and_leaves_channels_apart():
    picture = seen(FRAME, Framing(crop=(0, 0, 72, 72)), 24)
    mean = FRAME[:3, :3].astype(float).mean(axis=(0, 1))
    assert np.abs(picture[0, 0] - mean).max() <= 0.51
    assert np.array_equal(seen(FRAME[:, :, ::-1], Framing(), 24), seen(FRAME, Framing(), 24)[:, :, ::-1])


def test_a_quick_picture_is_of_the_same_part_of_the_frame():
    slope = np.broadcast_to(np.arange(256, dtype=np.uint8)[None, :, None], (72, 256, 3))
    exact, quick = (seen(slope, Framing(eye="left"), 54, quick=q).astype(int) for q in (False, True))
    assert np.abs(exact - quick).max() <= 1


@pytest.mark.parametrize(("settings", "word"), [
    ({"rotate": 45}, "rotate is 45"), ({"eye": "third"}, "third"), ({"crop": (0, 0, 5)}, "left, top"),
])  # fmt: skip
def test_a_framing_that_cannot_be_is_refused(settings, word):
    with pytest.raises(ConfigError, match=word):
        Framing(**settings)


def test_a_crop_outside_the_frame_says_both_sizes():
    with pytest.raises(ConfigError, match="100×72 at \\(200, 0\\) does not fit a picture of 256×72"):
        seen(FRAME, Framing(crop=(200, 0, 100, 72)), 24)
