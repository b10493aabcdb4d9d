"""A recorded attempt as other programs take it: arrays of T ticks, the observation after them, and where it belongs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from far_app.learning.dataset import Episode
from far_app.recording.attempt_reader import AttemptRecording
from far_app.recording.episodes import judged_episode
from far_app.recording.reader import SessionRecording
from far_app.types import Outcome, Step

Segment = Literal["attempt", "recovery"]


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Where a rollout belongs; strings and numbers that other formats carry beside it."""

    session: str
    trial: int
    attempt: int
    previous: str
    """Id (session/trial/attempt) of the attempt before on the same scene; "" for the first."""
    scene_seed: int
    task: str
    method: str
    policy: str
    policy_version: str
    success: bool
    judged_by: str
    note: str
    segment: Segment
    first_tick: int
    """Tick of the attempt at which the rollout begins."""
    adaptation: str
    """Status of the adaptation that followed; "" without one."""
    code_version: str
    wall_minus_monotonic: float
    """Seconds to add to a stamp to get seconds since 1970 UTC."""

    @property
    def id(self) -> str:
        return f"{self.session}/trial_{self.trial:04d}/attempt_{self.attempt}"


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """T ticks. `episode` has T + 1 rows: the last one is s_T, with the last action repeated, as for learning."""

    episode: Episode
    columns: dict[str, np.ndarray]
    """T rows of everything else that is known of a tick, by the name in COLUMNS."""
    provenance: Provenance

    def __len__(self) -> int:
        return len(self.episode) - 1


COLUMNS: dict[str, str] = {
    "time": "Measured capture time of the observation, seconds since the episode's first.",
    "stamp": "The same on the recording computer's monotonic clock (float64: LeRobot's loader rounds it to float32).",
    "lateness": "Seconds from the tick's deadline to the target's acceptance in the hw server; NaN when unknown.",
    "tick": "Tick of the attempt.",
    "joints": "Joint angles, radians.",
    "commanded": "Policy's action plus perturbation, clipped to [−1, 1]; `action` is what the safety filter let pass.",
    "perturbation": "δ_t.",
    "value": "V(s_t); NaN when not computed in time.",
    "value_change": "ΔV_t = V(s_{t+H}) − V(s_t); NaN where no whole chunk begins or nothing was attributed.",
    "flagged": "A chunk to blame for the failure begins here.",
    "starved": "No chunk reached the tick: the arm held.",
    "intervention": "A person moved the arm.",
    "chunk_tick": "Tick of the newest chunk that shaped the action; −1 without one.",
    "trial": "Trial of the session, from 1.",
    "attempt": "Attempt of the trial, from 1.",
    "success": "The attempt's outcome (the last word on it).",
}
"""What a rollout's columns mean."""


def human(step: Step) -> bool:
    """Whether a person moved the arm at this tick."""
    return bool(getattr(step, "intervention", False))


def rollout(
    session: SessionRecording, recording: AttemptRecording, outcome: Outcome, segment: Segment, first: int
) -> Rollout:
    """The ticks from `first` on. Raises RecordingError when the attempt never ended or an array is missing."""
    attempt, header = recording.attempt(), recording.header
    assert header is not None, "attempt() refuses a recording without one"
    episode = judged_episode(attempt, outcome)
    info = session.header.info
    provenance = Provenance(
        session=header.session, trial=header.trial, attempt=header.attempt, scene_seed=header.scene_seed,
        previous=f"{header.session}/{header.previous.removesuffix('.mcap')}" if header.previous else "",
        task=header.task, method=header.method, policy=info.policy, policy_version=header.policy_version,
        success=outcome.success, judged_by=outcome.judged_by.value, note=outcome.note, segment=segment,
        first_tick=first, adaptation=recording.adaptation.status if recording.adaptation else "",
        code_version=session.header.code_version, wall_minus_monotonic=header.wall_minus_monotonic,
    )  # fmt: skip
    columns = {name: column[first:] for name, column in _columns(recording, outcome).items()}
    columns["time"] = columns["stamp"] - columns["stamp"][0]
    return Rollout(episode=tail(episode, first), columns=columns, provenance=provenance)


def tail(episode: Episode, first: int) -> Episode:
    """The same without its first ticks."""
    return replace(
        episode, images={c: frames[first:] for c, frames in episode.images.items()}, states=episode.states[first:],
        actions=episode.actions[first:], rewards=episode.rewards[first:], successes=episode.successes[first:],
        objects=None if episode.objects is None else episode.objects[first:],
    )  # fmt: skip


def _columns(recording: AttemptRecording, outcome: Outcome) -> dict[str, np.ndarray]:
    steps, header, adaptation = recording.steps, recording.header, recording.adaptation
    assert header is not None
    count = len(steps)
    change, flagged = np.full(count, np.nan, np.float32), np.zeros(count, bool)
    if adaptation is not None:
        whole = min(count, len(adaptation.value_changes))
        change[:whole] = adaptation.value_changes[:whole]
        flagged[[tick for tick in adaptation.flagged if tick < count]] = True
    return {
        "stamp": np.array([s.stamp for s in steps]),
        "lateness": np.array([s.lateness for s in steps], np.float32),
        "tick": np.array([s.tick for s in steps], np.int64),
        "joints": np.array([s.observation.joints for s in steps], np.float32),
        "commanded": np.array([s.commanded for s in steps], np.float32),
        "perturbation": np.array([s.perturbation for s in steps], np.float32),
        "value": np.array([s.value for s in steps], np.float32),
        "value_change": change,
        "flagged": flagged,
        "starved": np.array([s.starved for s in steps], bool),
        "intervention": np.array([human(s) for s in steps], bool),
        "chunk_tick": np.array([s.chunk_tick for s in steps], np.int64),
        "trial": np.full(count, header.trial, np.int64),
        "attempt": np.full(count, header.attempt, np.int64),
        "success": np.full(count, outcome.success, bool),
    }
