"""A recorded session as episodes to learn from: every attempt that ended, with the last word said on it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from far_app.errors import ConfigError, RecordingError
from far_app.learning.dataset import Episode, episode_of, seen_and_done
from far_app.recording.reader import read_session
from far_app.types import Attempt, Outcome


def session_episodes(path: Path, task: str) -> list[Episode]:
    """Successes and failures of a session, in order; an attempt that was abandoned or cut off, or of which a
    person is unsure, is left out. Raises
    ConfigError for a session of another task."""
    session = read_session(path)
    if session.header.info.task != task:
        raise ConfigError(f"{path} is a session of task '{session.header.info.task}', these models are for '{task}'")
    episodes = []
    for recording in session.attempts():
        try:
            attempt = recording.attempt()
        except RecordingError:
            continue
        if not attempt.steps or recording.header is None:
            continue
        key = recording.header.trial, recording.header.attempt
        if key not in session.unsure:
            episodes.append(judged_episode(attempt, session.marks.get(key, attempt.outcome)))
    return episodes


def judged_episode(attempt: Attempt, outcome: Outcome) -> Episode:
    """An attempt under the last word on it. A success that only a person saw counts from its last tick."""
    episode = episode_of(*seen_and_done(attempt), outcome.success, attempt.scene_seed)
    completed = episode.successes & outcome.success
    if outcome.success and not completed.any():
        completed = np.arange(len(episode)) == len(episode) - 1
    return replace(episode, successes=completed)
