"""Keyed noise: the same key, the same numbers, whatever was drawn before."""

import numpy as np

from far_app.noise import keyed_noise


def test_a_key_always_gives_the_same_noise():
    first = keyed_noise((3, 1, 40), 8, 7)
    keyed_noise((3, 1, 41), 8, 7)
    assert np.array_equal(first, keyed_noise((3, 1, 40), 8, 7))
    assert first.shape == (8, 7) and first.dtype == np.float32


def test_scene_attempt_and_tick_all_matter():
    keys = [(s, a, t) for s in (0, 1) for a in (1, 2) for t in (0, 1)]
    chunks = [keyed_noise(k, 8, 7) for k in keys]
    assert len({c.tobytes() for c in chunks}) == len(keys)
    assert not np.array_equal(keyed_noise((1, 2, 3), 8, 7), keyed_noise((3, 2, 1), 8, 7))


def test_noise_is_standard_normal():
    draws = np.stack([keyed_noise((0, 1, t), 8, 7) for t in range(400)])
    assert abs(draws.mean()) < 0.02 and abs(draws.std() - 1) < 0.02
    assert abs(np.corrcoef(draws[:-1].ravel(), draws[1:].ravel())[0, 1]) < 0.02
