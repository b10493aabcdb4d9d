"""A dataset's pictures decoded once, into plain arrays beside it that later readers map into memory.

    datasets/lift.hdf5  →  datasets/lift.hdf5.decoded/STATE/CHOICE/front.npy, wrist.npy    (N, S, S, 3) uint8, all ticks

STATE is the file's size and time of change, so that a changed dataset never finds old pictures (they are deleted when
new ones are made); CHOICE is the hash of which demonstrations, cameras, size and framing. Several trainings on one
machine share the pages. Where nothing can be written the pictures are decoded into memory, as ever.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from far_app.learning.dataset import Episode, episode_count, read_episodes
from far_app.picture import Framing

log = logging.getLogger(__name__)


def decoded_episodes(
    path: Path,
    cameras: tuple[str, ...],
    limit: int | None = None,
    size: int | None = None,
    framings: Mapping[str, Framing] | None = None,
) -> list[Episode]:
    """As read_episodes, with pictures that are read-only maps of the decoded files; made when they are not there."""
    if not cameras or not path.exists():
        return read_episodes(path, cameras, limit, size, framings)
    folder = _state(path) / _choice(cameras, limit, size, framings)
    if not folder.exists():
        try:
            _decode(path, folder, cameras, limit, size, framings)
        except OSError as error:
            log.info("the decoded pictures of %s are not kept: %s", path, error)
            return read_episodes(path, cameras, limit, size, framings)
    episodes = read_episodes(path, (), limit)
    ends = np.cumsum([len(e) for e in episodes])
    whole = {c: np.load(folder / f"{c}.npy", mmap_mode="r") for c in cameras}
    return [
        dataclasses.replace(e, images={c: a[end - len(e) : end] for c, a in whole.items()})
        for e, end in zip(episodes, ends, strict=True)
    ]


def _decode(
    path: Path, folder: Path, cameras: tuple[str, ...], limit: int | None, size: int | None,
    framings: Mapping[str, Framing] | None,
) -> None:  # fmt: skip
    """Episode by episode, whole or not at all. Raises OSError where there is no room or no right to write."""
    partial = folder.with_name(f"{folder.name}-{os.getpid()}.partial")
    count = episode_count(path, limit)
    ticks = sum(len(e) for e in read_episodes(path, (), limit))
    try:
        partial.mkdir(parents=True)
        files: dict[str, np.ndarray] = {}
        at = 0
        for number in range(count):
            (episode,) = read_episodes(path, cameras, 1, size, framings, first=number)
            for camera, frames in episode.images.items():
                if camera not in files:
                    files[camera] = np.lib.format.open_memmap(
                        partial / f"{camera}.npy", mode="w+", dtype=np.uint8, shape=(ticks, *frames.shape[1:])
                    )
                files[camera][at : at + len(episode)] = frames
            at += len(episode)
        for file in files.values():
            file.flush()  # type: ignore[attr-defined]
        partial.rename(folder)
        for old in folder.parent.parent.iterdir():
            if old != folder.parent:
                shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _state(path: Path) -> Path:
    state = path.stat()
    return path.with_name(path.name + ".decoded") / f"{state.st_size:x}-{state.st_mtime_ns:x}"


def _choice(
    cameras: tuple[str, ...], limit: int | None, size: int | None, framings: Mapping[str, Framing] | None
) -> str:
    cut = {camera: dataclasses.asdict(framing) for camera, framing in sorted((framings or {}).items())}
    return hashlib.sha256(json.dumps([sorted(cameras), limit, size, cut]).encode()).hexdigest()[:24]
