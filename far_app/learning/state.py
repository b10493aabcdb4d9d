"""The state a policy sees beside its pictures: the arm's own, and the objects' where the preset is `state`.

proprioception   end effector: position (m), quaternion (xyzw); gripper opening                                  8
each object      position (m), position from the end effector (m), the first two columns of its rotation       12
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from far_app.errors import ConfigError
from far_app.learning.dataset import Episode
from far_app.types import Observation

PROPRIOCEPTION = 8
OBJECT = 12


def state_dim(objects: Sequence[str]) -> int:
    return PROPRIOCEPTION + OBJECT * len(objects)


def state_of(observation: Observation, objects: Sequence[str]) -> Float[np.ndarray, "D"]:
    """Of one observation."""
    eef = observation.eef
    own = np.concatenate([eef.position, eef.quaternion, [observation.gripper]]).astype(np.float32)
    if not objects:
        return own
    poses = [observation.objects[name] for name in objects]
    return with_objects(own[None], np.stack([[*p.position, *p.quaternion] for p in poses])[None])[0]


def states_of(episode: Episode, objects: Sequence[str]) -> Float[np.ndarray, "N D"]:
    """Of every tick of an episode. Raises ConfigError where it does not know these objects."""
    if not objects:
        return episode.states
    if episode.objects is None or episode.objects.shape[1] != 7 * len(objects):
        known = "no objects" if episode.objects is None else f"{episode.objects.shape[1] // 7} objects"
        raise ConfigError(
            f"the demonstrations know the poses of {known}, the policy sees {', '.join(objects)}; make them with "
            "`far demo`, or train a preset that sees pictures"
        )
    return with_objects(episode.states, episode.objects.reshape(len(episode), -1, 7))


def with_objects(own: Float[np.ndarray, "N 8"], poses: Float[np.ndarray, "N K 7"]) -> Float[np.ndarray, "N D"]:
    """Proprioception and objects, side by side; `poses` are positions and quaternions (xyzw)."""
    positions, (x, y, z, w) = poses[..., :3], np.moveaxis(poses[..., 3:], -1, 0)
    columns = np.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w),
        2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w),
    ], axis=-1)  # fmt: skip
    each = np.concatenate([positions, positions - own[:, None, :3], columns], axis=-1)
    return np.concatenate([own, each.reshape(len(own), -1)], axis=1).astype(np.float32)
