"""Random numbers keyed by what they are for, so that a scene's noise is the same for every method and every rerun.

A key is a purpose and whole numbers, usually (scene, attempt, tick); the generator is counter-based (Philox), so a
tick's numbers do not depend on which ticks were drawn before it.
"""

from __future__ import annotations

import zlib

import numpy as np


def generator(purpose: str, *key: int) -> np.random.Generator:
    """A generator of its own for this purpose and key; the same key always gives the same numbers."""
    return np.random.Generator(np.random.Philox(np.random.SeedSequence([zlib.crc32(purpose.encode()), *key])))
