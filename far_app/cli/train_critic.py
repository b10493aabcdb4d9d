"""`far train critic`: the IQL critic on a policy's features, from demonstrations and the policy's own attempts."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class TrainCriticOptions:
    """Train V and Q for one policy; the same command goes on where it was interrupted."""

    task: str = "lift"
    policy: Path | None = None
    """Checkpoint of the policy whose encoder the critic sees through; runs/TASK-quickstart's by default."""
    data: Path | None = None
    """Demonstrations (robomimic HDF5); datasets/TASK.hdf5 by default."""
    attempts: tuple[Path, ...] = ()
    """The policy's own rollouts, failed and successful (robomimic HDF5 files)."""
    out: Path | None = None
    """Folder of the run: checkpoint, state to go on from, log; the policy's by default."""
    demonstrations: int | None = None
    """How many demonstrations to use; all by default."""
    iterations: int | None = None
    """Gradient steps; the paper's by default."""
    reward: Literal["shaped", "sparse", "real"] = "shaped"
    """How ticks are rewarded: the task's shaped reward − 1, 3 at completion, or the paper's labels on a real robot."""
    encoder: Literal["shared", "own"] = "shared"
    """See through the policy's frozen encoder, or train an own one that begins as its copy (far slower)."""
    backup: int = 1
    """Ticks of reward in Q's target before V takes over; 1 is the paper's, 8 a whole quickstart chunk."""
    seed: int = 0
    threads: int = 2
    """torch threads."""


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(TrainCriticOptions, args=list(arguments), prog="far train critic")
    import torch

    from far_app.cli.settings import recommend
    from far_app.learning.dataset import read_episodes
    from far_app.learning.policy import load_policy, trained_framings, trained_setup
    from far_app.learning.train_critic import CriticTraining, train_critic
    from far_app.tasks import repeats

    torch.set_num_threads(options.threads)
    path = options.policy or Path("runs") / f"{options.task}-quickstart" / "policy.safetensors"
    policy = load_policy(path, options.task)
    training = CriticTraining(
        seed=options.seed, reward=options.reward, encoder=options.encoder, backup=options.backup
    )  # fmt: skip
    if options.iterations is not None:
        training = dataclasses.replace(training, iterations=options.iterations)
    cameras, size, framings = policy.config.cameras, policy.config.image_size, trained_framings(path)
    data = options.data or Path("datasets") / f"{options.task}.hdf5"
    demonstrations = read_episodes(data, cameras, options.demonstrations, size, framings)
    attempts = [e for file in options.attempts for e in read_episodes(file, cameras, None, size, framings)]
    card: dict[str, object] = {"command": "far train critic " + " ".join(arguments)}
    checkpoint = train_critic(demonstrations, attempts, policy, training, options.out or path.parent, card)
    log.info("wrote %s", checkpoint)
    setup = trained_setup(path)
    repeat = repeats(options.task, setup.arm) if setup is not None else 1
    if (settings := recommend(path, policy.config.preset, repeat)) is not None:
        log.info("wrote %s: settings of retrying that measured best for such policies", settings)
    return 0
