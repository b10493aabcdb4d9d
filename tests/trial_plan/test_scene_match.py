"""The score of a rebuilt scene: light, noise and a pixel of shift are forgiven, a small object out of place is not."""

from __future__ import annotations

import numpy as np
import pytest

from far_app.trial_plan.scene_match import match, score

SIZE = 84


def scene(x: int = 40, y: int = 48, cube: bool = True) -> np.ndarray:
    """A bright table with a dark gripper and a red cube of 8 × 8 pixels."""
    rows, columns = np.mgrid[0:SIZE, 0:SIZE]
    picture = np.stack([200 - 0.4 * rows, 195 - 0.3 * columns, 190 - 0.2 * rows], axis=-1)
    picture[:20] = (95, 97, 99)
    picture[4:24, 32:52] = (30, 32, 34)
    if cube:
        picture[y : y + 8, x : x + 8] = (180, 40, 45)
    return picture.clip(0, 255).astype(np.uint8)


def lit(picture: np.ndarray, gain: object, noise: float = 0.0) -> np.ndarray:
    noisy = picture * np.asarray(gain) + np.random.default_rng(0).normal(0, noise, picture.shape)
    return noisy.clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("live", [
    scene(), lit(scene(), 0.6), lit(scene(), 1.25), lit(scene(), (1.1, 1.0, 0.8)), lit(scene(), 1.0, noise=8),
    lit(scene(), np.linspace(0.85, 1.1, SIZE)[None, :, None]), np.roll(scene(), 1, axis=1), lit(scene(), 0.7, noise=6),
], ids=["the same", "dim", "bright", "warm", "noisy", "uneven", "one pixel", "dim and noisy"])  # fmt: skip
def test_what_is_no_difference_is_forgiven(live: np.ndarray):
    assert score(scene(), live) > 0.9


@pytest.mark.parametrize("light", [1.0, 0.7])
def test_a_cube_out_of_place_is_seen_in_any_light_and_the_further_the_worse(light: float):
    scores = [score(scene(), lit(scene(40 + dx), light)) for dx in (0, 3, 8, 20)]
    assert scores == sorted(scores, reverse=True) and scores[0] > 0.9 and scores[1] < 0.8 and scores[3] < 0.3
    assert score(scene(), lit(scene(cube=False), light)) < 0.5, "missing"
    assert score(scene(cube=False), lit(scene(), light)) < 0.5, "too much"


def test_pictures_of_other_sizes_are_compared_and_a_camera_that_shows_nothing_scores_nothing():
    large = np.kron(scene(), np.ones((4, 4, 1), np.uint8))
    assert score(scene(), large) > 0.9 and score(large, scene()) > 0.9
    assert score(large, np.kron(scene(60), np.ones((4, 4, 1), np.uint8))) < 0.5
    assert match({"front": scene(), "wrist": scene()}, {"front": scene()}) == {"front": pytest.approx(1.0), "wrist": 0}


def test_pictures_without_contrast_do_not_disturb_it():
    grey = np.full((SIZE, SIZE, 3), 90, np.uint8)
    assert score(grey, grey) == 1.0
    assert score(np.zeros_like(grey), np.full_like(grey, 255)) < 0.01


def test_another_scene_altogether_is_no_noise():
    drawn = np.random.default_rng(1).integers(0, 255, (2, 12, 12, 3)).astype(np.uint8)
    here, there = (np.kron(picture, np.ones((7, 7, 1), np.uint8)) for picture in drawn)
    assert score(here, there) < 0.02
