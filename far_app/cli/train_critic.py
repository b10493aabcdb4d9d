"""`far train critic`: the IQL critic on a policy's features, from demonstrations and the policy's own attempts."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True, kw_only=True)
class TrainCriticOptions:
    """Train V and Q for one policy; the same command goes on where it was interrupted."""

    policy: Path
    """Checkpoint of the policy whose encoder the critic sees through."""
    demos: Path
    """Demonstrations (robomimic HDF5)."""
    attempts: Path | None = None
    """The policy's own rollouts, failed and successful (robomimic HDF5)."""
    out: Path
    """Folder of the run: checkpoint, state to go on from, log."""
    demonstrations: int | None = None
    """How many demonstrations to use; all by default."""
    iterations: int | None = None
    """Gradient steps; the paper's by default."""
    seed: int = 0
    threads: int | None = None
    """Torch threads; torch's own choice by default."""


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(TrainCriticOptions, args=list(arguments), prog="far train critic")
    import torch

    from far_app.learning.dataset import read_episodes
    from far_app.learning.policy import load_policy
    from far_app.learning.train_critic import CriticTraining, train_critic

    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    policy = load_policy(options.policy)
    training = CriticTraining(seed=options.seed)
    if options.iterations is not None:
        training = dataclasses.replace(training, iterations=options.iterations)
    cameras = policy.config.cameras
    demonstrations = read_episodes(options.demos, cameras, options.demonstrations)
    attempts = read_episodes(options.attempts, cameras) if options.attempts is not None else []
    checkpoint = train_critic(demonstrations, attempts, policy, training, options.out)
    print(f"critic checkpoint: {checkpoint}")
    return 0
