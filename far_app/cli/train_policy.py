"""`far train policy`: the diffusion policy from demonstrations. Interrupted, it goes on where it was."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from far_app.errors import ConfigError
from far_app.tasks import task as find_task


@dataclass(frozen=True, kw_only=True)
class TrainPolicyOptions:
    """Train the diffusion policy on demonstrations; the same command goes on where it was interrupted."""

    demos: Path
    """Demonstrations (robomimic HDF5), as `far demo` writes them."""
    out: Path
    """Folder of the run: checkpoint, state to go on from, log."""
    task: str = "lift"
    preset: str = "quickstart"
    """quickstart or paper."""
    demonstrations: int | None = None
    """How many to use; all by default."""
    iterations: int | None = None
    """Gradient steps; the preset's by default."""
    batch: int | None = None
    lr: float | None = None
    seed: int = 0
    device: str = "cpu"
    imagenet: Path | None = None
    """torchvision's resnet18 weights file for the paper's encoder."""
    threads: int | None = None
    """Torch threads; torch's own choice by default."""


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(TrainPolicyOptions, args=list(arguments), prog="far train policy")
    find_task(options.task)
    import torch

    from far_app.cli.assemble import check_device
    from far_app.learning.dataset import read_episodes
    from far_app.learning.policy import preset
    from far_app.learning.train_policy import TRAININGS, train_policy

    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    config = preset(options.preset, options.task)
    check_device(options.device)
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    given = {k: getattr(options, k) for k in ("iterations", "batch", "lr") if getattr(options, k) is not None}
    training = dataclasses.replace(TRAININGS[options.preset], seed=options.seed, **given)
    imagenet = None
    if options.imagenet is not None:
        if not options.imagenet.exists():
            raise ConfigError(
                f"no ImageNet weights at {options.imagenet}; give torchvision's resnet18 file or leave it out"
            )
        imagenet = torch.load(options.imagenet, map_location="cpu", weights_only=True)
    episodes = read_episodes(options.demos, config.cameras, options.demonstrations)
    checkpoint = train_policy(episodes, config, training, options.out, options.device, imagenet=imagenet)
    print(f"policy checkpoint: {checkpoint}")
    return 0
