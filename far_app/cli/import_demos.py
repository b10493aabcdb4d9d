"""`far import FILE|FOLDER --out demos.hdf5`: demonstrations made elsewhere (or exported here) as D_exp."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from far_app.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """robomimic HDF5 or LeRobotDataset v3 as demonstrations; says what becomes what, and refuses what cannot."""

    source: tyro.conf.Positional[Path]
    """An HDF5 file, or a dataset's folder."""
    out: Path
    """HDF5 file for --data of far train and far improve."""
    cameras: dict[str, str] = field(default_factory=dict)
    """Our camera and the source's key, in pairs: front agentview_image wrist robot0_eye_in_hand_image."""
    gripper: tuple[float, float] | None = None
    """The source's gripper reading when closed and when open, where the gripper is not a Panda's or ours."""
    image_size: int | None = None
    """Cut pictures to their largest centred square and scale it to so many pixels; whole frames by default, of which
    training makes the pictures its policy sees."""
    overwrite: bool = False
    """Replace what is at --out."""


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(ImportOptions, args=list(arguments), prog="far import")
    from far_app.exchange.foreign import Foreign
    from far_app.exchange.target import whole
    from far_app.learning.dataset import write_episode

    if not options.source.exists():
        raise ConfigError(f"{options.source} does not exist; give a robomimic HDF5 file or a LeRobotDataset's folder")
    wanted = Foreign(cameras=options.cameras, gripper=options.gripper, image_size=options.image_size)
    count = ticks = 0
    with whole(options.out, options.overwrite) as half:
        if options.source.is_dir():
            from far_app.exchange.lerobot_read import read_lerobot

            env_args, episodes = read_lerobot(options.source, wanted, print)
        else:
            from far_app.exchange.robomimic_read import read_robomimic

            env_args, episodes = read_robomimic(options.source, wanted, print)
        for episode in episodes:
            write_episode(half, episode, env_args)
            count, ticks = count + 1, ticks + len(episode)
        if not count:
            raise ConfigError(f"nothing of {options.source} could be imported")
    print(f"{options.out}: {count} episodes, {ticks} ticks")
    return 0
