"""Batches of consecutive ticks from demonstrations, and their features with every frame encoded once.

Two histories that share a frame share its features, so a light encoder sees five frames for four histories instead of
eight. The random shift moves a segment's pictures by a few pixels; what comes in at an edge repeats that edge. Pictures
stay where the episodes have them (a map of a file, perhaps): only those of a batch are touched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from far_app.errors import ConfigError
from far_app.learning.dataset import Episode
from far_app.learning.policy import DiffusionPolicy, PolicyConfig
from far_app.learning.state import states_of


@dataclass(frozen=True, kw_only=True)
class Segments:
    """S segments of L consecutive ticks."""

    images: dict[str, UInt8[Tensor, "S L+n_obs−1 P P 3"]]
    states: Float[Tensor, "S L+n_obs−1 D"]
    chunks: Float[Tensor, "S L H A"]
    offsets: Float[Tensor, "S L K"] | None
    """Of the objects from the hand, where they are known."""
    rows: Int[np.ndarray, "S L"]
    """Which of all ticks each is."""


class DemonstrationArrays:
    """All demonstrations, addressed by (episode, tick)."""

    def __init__(self, episodes: Sequence[Episode], config: PolicyConfig, shift: int) -> None:
        if not episodes:
            raise ConfigError("no demonstrations to train on; make some with `far demo`")
        self.config, self.shift = config, shift
        self.lengths = np.array([len(e) for e in episodes])
        self.starts = np.concatenate([[0], np.cumsum(self.lengths)[:-1]])
        self.images = {c: [e.images[c] for e in episodes] for c in config.cameras}
        self.states = np.concatenate([states_of(e, config.objects) for e in episodes])
        self.actions = np.concatenate([e.actions for e in episodes])
        self.offsets = object_offsets(episodes)
        self.ends = np.repeat(self.starts + self.lengths - 1, self.lengths)
        """Row of the last tick of each row's episode."""

    def segments(self, count: int, length: int, rng: np.random.Generator) -> Segments:
        """`count` segments of `length` ticks. Ticks before an episode's first repeat it, actions past its last repeat
        it."""
        n_obs, horizon, size = self.config.n_obs, self.config.horizon, self.config.image_size
        rows = rng.integers(0, len(self.ends), count)
        first = np.searchsorted(self.starts, rows, side="right") - 1
        start = np.minimum(rows, np.maximum(self.ends[rows] - length + 1, self.starts[first]))
        span = np.arange(-(n_obs - 1), length)
        frames = np.clip(start[:, None] + span, self.starts[first][:, None], self.ends[rows][:, None])
        offsets = rng.integers(0, 2 * self.shift + 1, (count, 2))
        images = {c: self._shifted(c, first, frames, offsets, size) for c in self.config.cameras}
        ticks = frames[:, n_obs - 1 :]
        index = np.minimum(ticks[..., None] + np.arange(horizon), self.ends[rows][:, None, None])
        located = None if self.offsets is None else torch.from_numpy(self.offsets[ticks])
        return Segments(
            images=images, states=torch.from_numpy(self.states[frames]), chunks=torch.from_numpy(self.actions[index]),
            offsets=located, rows=ticks,
        )  # fmt: skip

    def _shifted(
        self, camera: str, episode: np.ndarray, frames: np.ndarray, offsets: np.ndarray, size: int
    ) -> UInt8[Tensor, "S F P P 3"]:
        """Each segment's pictures moved by its offset, 0 … 2 · shift; the middle leaves them as they are."""
        out = np.empty((*frames.shape, size, size, 3), np.uint8)
        local = frames - self.starts[episode][:, None]
        for i, (y, x) in enumerate(self._pixels(offsets, size)):
            out[i] = self.images[camera][episode[i]][local[i]].take(y, axis=1).take(x, axis=2)
        return torch.from_numpy(out)

    def _pixels(self, offsets: Int[np.ndarray, "S 2"], size: int) -> Int[np.ndarray, "S 2 P"]:
        """Which row and which column of a picture each of the moved one's is."""
        return np.clip(offsets[:, :, None] + np.arange(size) - self.shift, 0, size - 1)


class DeviceDemonstrations(DemonstrationArrays):
    """The same batches with all pictures on a GPU: a batch is gathered there, and nothing but indices travels."""

    def __init__(self, episodes: Sequence[Episode], config: PolicyConfig, shift: int, device: str) -> None:
        super().__init__(episodes, config, shift)
        self._all = {c: torch.cat([torch.tensor(a, device=device) for a in v]) for c, v in self.images.items()}
        self.images = {}

    def _shifted(
        self, camera: str, episode: np.ndarray, frames: np.ndarray, offsets: np.ndarray, size: int
    ) -> UInt8[Tensor, "S F P P 3"]:
        pictures = self._all[camera]
        pixels = torch.from_numpy(self._pixels(offsets, size)).to(pictures.device, non_blocking=True)
        rows = torch.from_numpy(frames).to(pictures.device, non_blocking=True)
        return pictures[rows[:, :, None, None], pixels[:, None, 0, :, None], pixels[:, None, 1, None, :]]


def object_offsets(episodes: Sequence[Episode]) -> np.ndarray | None:
    """Object positions relative to the hand in units of 10 cm, (N, 3 · objects); None where they are not known."""
    if any(e.objects is None for e in episodes):
        return None
    parts = [
        e.objects.reshape(len(e), -1, 7)[:, :, :3] - e.states[:, None, :3] for e in episodes if e.objects is not None
    ]
    return (np.concatenate(parts).reshape(sum(map(len, parts)), -1) * 10.0).astype(np.float32)


def history_features(policy: DiffusionPolicy, images: dict[str, Tensor], states: Tensor) -> Tensor:
    """Features of every history in a batch of segments, (count · length, F), each history encoded for itself."""
    n_obs = policy.config.n_obs
    length = states.shape[1] - n_obs + 1

    def histories(x: Tensor) -> Tensor:
        return torch.stack([x[:, t : t + length] for t in range(n_obs)], dim=2).flatten(0, 1)

    return policy.features({c: histories(x) for c, x in images.items()}, histories(states))


def segment_features(policy: DiffusionPolicy, images: dict[str, Tensor], states: Tensor) -> Tensor:
    """Features of every history in a batch of segments, (count · length, F); each frame is encoded once where the
    encoder shares its weights over the frames."""
    encoder, n_obs = policy.encoder, policy.config.n_obs
    count, frames = states.shape[:2]
    length = frames - n_obs + 1
    normalised = policy.normalizer(states)
    windows = [slice(t, t + length) for t in range(n_obs)]
    state = torch.stack([normalised[:, w].flatten(0, 1) for w in windows], dim=1)
    if encoder.per_frame:
        parts = [[encoder.camera_features(c, t, images[c][:, w].flatten(0, 1)) for c in encoder.camera_names]
                 for t, w in enumerate(windows)]  # fmt: skip
    else:
        once = {c: encoder.camera_features(c, 0, images[c].flatten(0, 1)).unflatten(0, (count, frames))
                for c in encoder.camera_names}  # fmt: skip
        parts = [[once[c][:, w].flatten(0, 1) for c in encoder.camera_names] for w in windows]
    return encoder.join(parts, state)
