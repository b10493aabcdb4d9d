"""Primitives as triangle meshes, for the page's 3D view."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

Solid = tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]


def box(half: Float[np.ndarray, "3"]) -> Solid:
    """By its half sizes, metres, around the origin."""
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    return corners, np.array([triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))])


def cylinder(radius: float, half_height: float, sections: int = 24) -> Solid:
    """Along z, around the origin, metres."""
    turn = np.arange(sections) * 2 * np.pi / sections
    ring = radius * np.column_stack([np.cos(turn), np.sin(turn)])
    low, high = (np.column_stack([ring, np.full(sections, z)]) for z in (-half_height, half_height))
    ends = np.array([(0, 0, -half_height), (0, 0, half_height)])
    a = np.arange(sections)
    b = (a + 1) % sections
    bottom, top = np.full(sections, 2 * sections), np.full(sections, 2 * sections + 1)
    faces = [(a, b, b + sections), (a, b + sections, a + sections), (b, a, bottom), (a + sections, b + sections, top)]
    return np.concatenate([low, high, ends]), np.concatenate([np.column_stack(f) for f in faces])
