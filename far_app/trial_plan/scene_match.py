"""Does a rebuilt scene look as it did? A score of two pictures of one fixed camera that forgives light and noise.

    1. Both are shrunk to at most SIDE pixels and blurred a little: noise and compression go.
    2. The reference is put into the live light: gain and offset of each colour by least absolute deviations over the
       pixels that are neither black nor saturated in either, so that what moved does not pull the fit.
    3. A pixel differs when it lies outside the range of the other's 3 × 3 surroundings (either way) by more than
       TOLERANCE grey levels and four times the usual difference (at most NOISE): one pixel of shift is forgiven.
    4. Specks are dropped; share = what is left over all pixels;  score = 1 / (1 + share / HALF).

So 1 is "nothing is out of place", ½ is HALF of the picture differing (a cube moved by its own width), and it falls on
as more does. A mean or a correlation over the picture would hardly see a small object moved; this sees little else. On
the twin at 84 pixels, light dimmed to 0.7 or uneven by a quarter and noise of 8 levels all score 1.0; the cube 1 cm off
scores 0.6 to 0.8 in the wrist's view and is one pixel (forgiven) in the front's; 2 cm off scores 0.26, and 0.5 to 0.85.
A cube turned in place by less than 45° does not show at that size.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Float, UInt8

SIDE = 160
"""Pixels of the longer side that are compared."""
TOLERANCE = 16.0
"""Grey levels of 255."""
NOISE = 40.0
"""Grey levels; where half of the picture differs by more, that is no noise."""
HALF = 0.004
"""Share of the picture that halves the score."""
SPECK = 5
"""Pixels; smaller connected differences are noise."""
_BLACK, _WHITE = 5.0, 250.0
_FEW = 50
"""Pixels below which no light is fitted."""

Picture = UInt8[np.ndarray, "H W 3"]


def match(reference: Mapping[str, Picture], live: Mapping[str, Picture]) -> dict[str, float]:
    """Score of every camera of the reference, 0 to 1; 0 for one that shows nothing."""
    return {camera: score(picture, live[camera]) if camera in live else 0.0 for camera, picture in reference.items()}


def score(reference: Picture, live: Picture) -> float:
    """Of one camera, 0 to 1, by the rule above. RGB; another size of the live picture is brought to the reference's."""
    differing = difference(reference, live)
    usual = 4 * 1.4826 * float(np.median(differing))
    mask = (differing > min(max(TOLERANCE, usual), NOISE)).astype(np.uint8)
    _, _, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    share = float(areas[areas >= SPECK].sum()) / mask.size
    return 1.0 / (1.0 + share / HALF)


def difference(reference: Picture, live: Picture) -> Float[np.ndarray, "h w"]:
    """Grey levels by which the worst colour lies outside what the other picture shows there, light forgiven; at the
    compared size."""
    there, here = _shrunk(reference, reference.shape), _shrunk(live, reference.shape)
    gain = np.ones(3, np.float32)
    for channel in range(3):
        there[..., channel], gain[channel] = _in_light_of(there[..., channel], here[..., channel])
    outside = np.maximum(_outside(here, there), _outside(there, here))
    return (outside / np.maximum(gain, 1.0)).max(axis=-1)


def _shrunk(picture: Picture, shape: tuple[int, ...]) -> Float[np.ndarray, "h w 3"]:
    scale = min(1.0, SIDE / max(shape[:2]))
    size = (max(1, round(shape[1] * scale)), max(1, round(shape[0] * scale)))
    way = cv2.INTER_AREA if size[0] <= picture.shape[1] else cv2.INTER_LINEAR
    return cv2.GaussianBlur(cv2.resize(picture, size, interpolation=way).astype(np.float32), (0, 0), 0.8)


def _in_light_of(there: np.ndarray, here: np.ndarray) -> tuple[np.ndarray, float]:
    """The reference's channel as the live light would show it, and the gain."""
    usable = (there > _BLACK) & (there < _WHITE) & (here > _BLACK) & (here < _WHITE)
    x, y = there[usable], here[usable]
    if len(x) < _FEW or np.ptp(x) < 2 * TOLERANCE:
        return there, 1.0
    gain, offset = 1.0, float(np.median(y - x))
    for _ in range(10):  # least absolute deviations by reweighted least squares
        weight = 1.0 / np.maximum(np.abs(y - gain * x - offset), 2.0)
        x0, y0 = np.average(x, weights=weight), np.average(y, weights=weight)
        spread = float((weight * (x - x0) ** 2).sum())
        gain = float(np.clip((weight * (x - x0) * (y - y0)).sum() / max(spread, 1e-6), 0.4, 2.5))
        offset = float(y0 - gain * x0)
    return np.clip(gain * there + offset, 0.0, 255.0), gain


def _outside(picture: np.ndarray, other: np.ndarray) -> np.ndarray:
    around = np.ones((3, 3), np.uint8)
    return np.maximum(np.maximum(picture - cv2.dilate(other, around), cv2.erode(other, around) - picture), 0.0)
