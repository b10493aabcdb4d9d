"""`far demo --teleop` and `--by-hand`: a person's demonstrations, each kept, discarded or recorded again.

Everything is recorded as a session, kept or not; what is kept goes to the dataset that `far train` reads.
"""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path
from typing import Literal

import numpy as np

from far_app.cli.lockstep_twin import origin
from far_app.cli.options import RunOptions
from far_app.cli.run import Ending
from far_app.cli.stage import Stage, stage
from far_app.demonstrations import SEED_OFFSET
from far_app.endpoints import Endpoints
from far_app.errors import ConfigError
from far_app.learning.dataset import check_origin, count_episodes, last_scene, write_episode
from far_app.recording.episodes import judged_episode
from far_app.session.inbox import IntentInbox
from far_app.session.session import Session
from far_app.session.statistics import LoopStatistics
from far_app.types import Attempt

log = logging.getLogger(__name__)

LEAD = 5
"""Ticks kept before the first motion: while the person found the controls nothing was demonstrated."""
MOVES = 1e-3
"""Of an action's largest component: less is no motion."""


def record(
    options: RunOptions, how: Literal["teleop", "hand"], n: int, first_seed: int, out: Path | None
) -> tuple[Path, int]:
    """Record until the dataset holds `n` demonstrations, or the operator ends it; the dataset, and how many it holds.
    Raises the FarError of whatever stood in the way."""
    if options.load_rig().robot == "twin" and how == "hand":
        raise ConfigError("the twin cannot be led by hand; say --teleop, or --robot xarm for a real arm")
    path = out or Path("datasets") / f"{options.task}.person.hdf5"
    there = count_episodes(path)
    if there >= n:
        return path, there
    seed = SEED_OFFSET + first_seed + last_scene(path)
    options = dataclasses.replace(options, trials=n - there, seed=seed, max_attempts=1, full_speed=True)
    with Ending() as ending, stage(options, person=True) as made:
        check_origin(path, origin(made.task, made.rig))
        writer = made.writer()
        if made.page_url:
            print(f"The operator page is at {made.page_url}; kept demonstrations go to {path}", flush=True)
        inbox = IntentInbox(Endpoints.in_folder(made.folder).intents)
        ending.tell(inbox)
        try:
            with made.session(
                writer, inbox, LoopStatistics(), demonstrate=how, keep=lambda attempt: keep(path, made, attempt)
            ) as session:
                run(session)
        finally:
            inbox.close()
    return path, count_episodes(path)


def run(session: Session) -> None:
    """To its end. Raises the error that ended the recording, too."""
    session.run()
    if session.recorder.error is not None:
        raise session.recorder.error


def keep(path: Path, made: Stage, attempt: Attempt) -> None:
    """Add a demonstration to the dataset."""
    write_episode(path, judged_episode(begun(attempt), attempt.outcome), origin(made.task, made.rig))
    log.info("demonstration of scene %d kept: %d in %s", attempt.scene_seed, count_episodes(path), path)


def begun(attempt: Attempt) -> Attempt:
    """The same from shortly before the first motion."""
    actions = np.array([s.sent if np.isfinite(s.sent).all() else s.commanded for s in attempt.steps])
    moving = np.abs(actions[:, :6]).max(axis=1) > MOVES
    moving[1:] |= actions[1:, 6] != actions[:-1, 6]
    first = int(np.argmax(moving)) if moving.any() else 0
    return dataclasses.replace(attempt, steps=attempt.steps[max(0, first - LEAD) :])
