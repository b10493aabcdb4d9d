"""Before the first motion: where a policy's data come from against where it is about to act, in words.

A Setup is written into a dataset when it is made, copied from there into the policy's card when it is trained, and made
anew of the rig that is about to move. Called by `far run`; pure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from jaxtyping import UInt8

from far_app.picture import Framing
from far_app.types import Observation

SAME = 0.01
"""Relative difference of a rate or a scale that counts as none."""
BLANK = 2.0
"""Standard deviation of a picture's values (of 255) below which it shows nothing."""
COLOUR = 25.0
"""Difference of a picture's mean colour (of 255) from the dataset's that is never worth a word."""
SPREAD = 4.0
"""The same in standard deviations over the dataset's pictures."""


@dataclass(frozen=True, kw_only=True)
class SeenView:
    """One camera view."""

    framing: Framing = field(default_factory=Framing)
    width: int = 0
    """Pixels of the whole frames it is cut from; 0 where a twin draws it."""
    height: int = 0

    def words(self) -> str:
        if not self.width:
            return "drawn by the twin"
        return f"frames of {self.width}×{self.height}, {self.framing.words()}"


@dataclass(frozen=True, kw_only=True)
class Setup:
    """What a policy's data say of the robot they were made on, or what a robot is now."""

    robot: str
    """"twin" or "xarm"."""
    arm: str
    rate: float
    """Policy ticks a second."""
    translation: float
    """Metres a tick at ±1."""
    rotation: float
    """Radians a tick at ±1."""
    image_size: int
    """Pixels, square."""
    views: Mapping[str, SeenView]

    def table(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def setup_from(table: Any) -> Setup | None:
    """A Setup from a dataset's or a card's JSON; None where there is none or it is of another time."""
    try:
        views = {
            name: SeenView(
                framing=Framing(**{**view["framing"], "crop": tuple(view["framing"]["crop"])}),
                width=view["width"], height=view["height"],
            )
            for name, view in table["views"].items()
        }  # fmt: skip
        return Setup(**{**table, "views": views})
    except (KeyError, TypeError):
        return None


def differences(trained: Setup, here: Setup, cameras: Sequence[str]) -> list[str]:
    """What is not here as it was in the policy's data, for a policy that looks through these cameras."""
    found = []
    if trained.robot != here.robot:
        found.append(f"the policy learnt from the {name_of(trained.robot)}, this is the {name_of(here.robot)}")
    if trained.arm != here.arm:
        found.append(f"the policy learnt on a {trained.arm}, this is a {here.arm}")
    if apart(trained.rate, here.rate):
        found.append(f"the policy learnt at {trained.rate:.3g} ticks a second, the task runs at {here.rate:.3g}")
    if apart(trained.translation, here.translation):
        found.append(
            f"an action of 1 moved the hand by {1e3 * trained.translation:.3g} mm, here by "
            f"{1e3 * here.translation:.3g} mm (scale.translation)"
        )
    if apart(trained.rotation, here.rotation):
        found.append(
            f"an action of 1 turned the hand by {trained.rotation:.3g} rad, here by {here.rotation:.3g} rad "
            "(scale.rotation)"
        )
    if cameras and trained.image_size != here.image_size:
        found.append(
            f"the policy's pictures have {trained.image_size}×{trained.image_size} pixels, the rig's "
            f"{here.image_size}×{here.image_size} (policy_image)"
        )
    for camera in cameras:
        if camera not in here.views:
            found.append(f"the policy looks through '{camera}', the rig has {', '.join(here.views) or 'no camera'}")
        elif camera in trained.views and trained.views[camera] != here.views[camera]:
            before, now = trained.views[camera].words(), here.views[camera].words()
            found.append(f"camera '{camera}' was {before}; here it is {now}")
    return found


def look(observation: Observation, cameras: Sequence[str], colours: Any = None) -> list[str]:
    """What is odd about the live pictures themselves; `colours` is what `colours_of` told of the dataset's."""
    found = []
    shown = [camera for camera in cameras if camera in observation.images]
    for i, camera in enumerate(shown):
        picture = observation.images[camera]
        if picture.std() < BLANK:
            found.append(f"camera '{camera}' shows nothing (all its pixels are alike): its cap, the light, its cable?")
            continue
        found += [
            f"cameras '{other}' and '{camera}' show the same picture"
            for other in shown[:i]
            if np.array_equal(observation.images[other], picture)
        ]
        known = colours.get(camera) if isinstance(colours, dict) else None
        if known is not None:
            mean, usual = picture.mean(axis=(0, 1)), np.array(known["mean"])
            if (np.abs(mean - usual) > np.maximum(COLOUR, SPREAD * np.array(known["sd"]))).any():
                found.append(
                    f"camera '{camera}' looks different from the policy's data: mean red, green, blue "
                    f"{triple(mean)}, there {triple(usual)}: the light, the view, or two cameras exchanged?"
                )
    return found


def colours_of(pictures: UInt8[np.ndarray, "N S S 3"]) -> dict[str, list[float]]:
    """Mean red, green and blue of pictures, and how they vary from picture to picture (of 255)."""
    means = pictures.mean(axis=(1, 2))
    return {"mean": means.mean(axis=0).round(1).tolist(), "sd": means.std(axis=0).round(1).tolist()}


def name_of(robot: str) -> str:
    return "twin" if robot == "twin" else f"real arm ({robot})"


def apart(a: float, b: float) -> bool:
    return abs(a - b) > SAME * max(abs(a), abs(b))


def triple(colour: np.ndarray) -> str:
    return "/".join(f"{value:.0f}" for value in colour)
