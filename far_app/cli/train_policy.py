"""`far train policy`: behaviour cloning from demonstrations, resumable."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from far_app.errors import CheckpointError

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class TrainPolicyOptions:
    """Train the diffusion policy; a second start goes on where the first one stopped."""

    task: str = "lift"
    preset: str = "quickstart"
    """quickstart or paper."""
    data: Path | None = None
    """Demonstrations (robomimic HDF5); datasets/TASK.hdf5 by default."""
    demonstrations: int | None = None
    """Use the first so many of them."""
    out: Path | None = None
    """Folder of the run; runs/TASK-PRESET by default."""
    cameras: tuple[str, ...] | None = None
    """The views it looks through; the preset's (front and wrist) by default. The paper's real arm has front alone."""
    rig: str | None = None
    """The dataset's pictures are whole frames of this rig's cameras: cut and shrink them as its live ones."""
    iterations: int | None = None
    """The preset's number by default."""
    seed: int = 0
    device: str = "cpu"
    threads: int = 2
    """torch threads."""
    bf16: bool = False
    """Camera networks in bfloat16 on a CPU too: quicker where the processor multiplies it itself (AMX, AVX-512 BF16),
    and no longer the same to the bit on every machine. A GPU always does so."""
    norm: Literal["group", "batch"] = "group"
    """Normalisation in the paper preset's ResNets."""
    imagenet: Path | None = None
    """torchvision's resnet18 file (paper preset); found in its cache or downloaded by default."""


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(TrainPolicyOptions, args=list(arguments), prog="far train policy")
    import torch

    from far_app.cli.assemble import check_device
    from far_app.learning.dataset import read_setup
    from far_app.learning.decoded import decoded_episodes
    from far_app.learning.imagenet import resnet18_weights
    from far_app.learning.policy import preset
    from far_app.learning.policy_step import FastStep, LowStep
    from far_app.learning.train_policy import TRAININGS, train_policy
    from far_app.preflight import colours_of
    from far_app.tasks import task as find_task
    from hw.camera_config import views_of, with_views
    from hw.rig import load_rig
    from hw.setup import setup_of

    check_device(options.device)
    torch.set_num_threads(options.threads)
    task = find_task(options.task)
    config = dataclasses.replace(preset(options.preset, task.name), norm=options.norm)
    if options.cameras is not None:
        config = dataclasses.replace(config, cameras=options.cameras)
    training = dataclasses.replace(TRAININGS[options.preset], seed=options.seed)
    if options.iterations is not None:
        training = dataclasses.replace(training, iterations=options.iterations)
    weights = None
    if config.encoder == "resnet18":
        try:
            weights = resnet18_weights(options.imagenet)
        except CheckpointError as error:
            log.warning("%s; training starts from random weights", error)
    data = options.data or Path("datasets") / f"{task.name}.hdf5"
    setup, framings = read_setup(data), None
    if options.rig is not None:
        rig = load_rig(options.rig, task.name)
        framings = views_of(rig.cameras or {})
        setup = setup_of(rig, with_views(find_task(task.name, rig.arm), rig.cameras)).table()
    episodes = decoded_episodes(data, config.cameras, options.demonstrations, config.image_size, framings)
    folder = options.out or Path("runs") / f"{task.name}-{options.preset}"
    card: dict[str, object] = {"command": "far train policy " + " ".join(arguments)}
    if setup is not None:
        card["setup"] = setup
    if config.cameras:
        card["colours"] = {c: colours_of(np.concatenate([e.images[c][::8] for e in episodes])) for c in config.cameras}
    form = LowStep if options.bf16 else FastStep
    path = train_policy(episodes, config, training, folder, options.device, card, weights, form=form)
    log.info("wrote %s", path)
    return 0
