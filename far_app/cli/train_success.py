"""`far train success`: a detector of success on the policy's frozen encoder, calibrated to a false-success rate."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from far_app.cli.assemble import checkpoints


@dataclass(frozen=True, kw_only=True)
class TrainSuccessOptions:
    """Learn from outcomes what success looks like."""

    task: str = "lift"
    policy: Path | None = None
    """Checkpoint whose encoder the detector sees through; the shipped one by default."""
    data: Path | None = None
    """Demonstrations (robomimic HDF5); datasets/TASK.hdf5 by default."""
    demonstrations: int | None = None
    """Use the first so many of them."""
    attempts: tuple[Path, ...] = ()
    """The policy's attempts, failed and successful (HDF5, `far demo --policy … --linger 10`)."""
    sessions: tuple[Path, ...] = ()
    """Recorded sessions, whose attempts are used too."""
    out: Path | None = None
    """The detector's file; success.safetensors beside the policy by default, in runs/ for the shipped one."""
    false_success: float = 0.01
    """Probability that a failed attempt is taken for a success, at most; 0.01 needs 99 failures to calibrate on."""
    held_out: float = 0.5
    """Share of the attempts that only calibrate."""
    consecutive: int = 5
    """Frames in a row that must agree."""
    last: int = 10
    """Last frames of a success that show it."""
    seed: int = 0


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(TrainSuccessOptions, args=list(arguments), prog="far train success")
    import torch

    from far_app.learning.dataset import read_episodes
    from far_app.learning.policy import load_policy, trained_framings
    from far_app.learning.success import save_detector
    from far_app.learning.train_success import SuccessTraining, train_success, watch
    from far_app.recording.episodes import session_episodes

    torch.set_num_threads(1)
    path, _ = checkpoints(options.task, options.policy, None)
    policy = load_policy(path, options.task)
    training = SuccessTraining(
        false_success=options.false_success, held_out=options.held_out, consecutive=options.consecutive,
        last=options.last, seed=options.seed,
    )  # fmt: skip
    config, framings = policy.config, trained_framings(path)
    data = options.data or Path("datasets") / f"{options.task}.hdf5"
    shown = watch(policy, read_episodes(data, config.cameras, options.demonstrations, config.image_size, framings))
    attempts = [
        *(w for file in options.attempts for w in watch(policy, read_episodes(
            file, config.cameras, None, config.image_size, framings))),
        *(w for session in options.sessions for w in watch(policy, session_episodes(session, options.task))),
    ]  # fmt: skip
    head, rule, card = train_success(shown, attempts, training)
    beside = path.with_name("success.safetensors") if options.policy else Path("runs") / f"{options.task}.success"
    out = options.out or beside.with_suffix(".safetensors")
    card |= {"command": "far train success " + " ".join(arguments), "training": dataclasses.asdict(training)}
    save_detector(head, rule, policy, out, card)
    print(
        f"wrote {out}: threshold {rule.threshold:.2f} (unsure from {rule.lower:.2f}), from "
        f"{card['calibrated_on_failures']} failures at a false-success rate of {rule.false_success:g}; it finds "
        f"{card['found']:.3f} of {card['held_out_successes']} held-out successes"
    )
    return 0
