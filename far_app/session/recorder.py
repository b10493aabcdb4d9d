"""The session's way to its SessionWriter: an error ends the recording once and is asked for once a tick, instead of
surfacing in the middle of whatever the loop was doing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from far_app.errors import RecordingError
from far_app.recording.scene_file import SceneAccepted
from far_app.recording.writer import SessionWriter
from far_app.types import ActionChunk, Adaptation, AdaptationStep, AdaptedWeights, Attempt, Outcome, Step, TickTimes


class Recorder:
    """Hands on to the writer; without one it keeps nothing (tests and measurements of the bare loop)."""

    def __init__(self, writer: SessionWriter | None = None) -> None:
        self._writer = writer
        self._error: RecordingError | None = None

    @property
    def error(self) -> RecordingError | None:
        """Why nothing more is recorded."""
        return self._error or (self._writer.error if self._writer is not None else None)

    @property
    def folder(self) -> Path | None:
        """The session's folder; None without a writer."""
        return self._writer.folder if self._writer is not None else None

    def begin_trial(self, trial: int, scene_seed: int, detail: Mapping[str, Any] | None = None) -> None:
        self._hand(lambda w: w.begin_trial(trial, scene_seed, detail))

    def scene(self, accepted: SceneAccepted) -> None:
        self._hand(lambda w: w.add_scene(accepted))

    def begin_attempt(self, index: int, policy_version: str) -> None:
        self._hand(lambda w: w.begin_attempt(index, policy_version))

    def add_chunk(self, chunk: ActionChunk) -> None:
        self._hand(lambda w: w.add_chunk(chunk))

    def add_step(self, step: Step) -> None:
        self._hand(lambda w: w.add_step(step))

    def add_tick_times(self, times: TickTimes) -> None:
        self._hand(lambda w: w.add_tick_times(times))

    def end_attempt(self, attempt: Attempt) -> None:
        self._hand(lambda w: w.end_attempt(attempt))

    def abandon_attempt(self, reason: str) -> None:
        self._hand(lambda w: w.abandon_attempt(reason))

    def add_adaptation_step(self, step: AdaptationStep) -> None:
        self._hand(lambda w: w.add_adaptation_step(step))

    def add_adaptation(self, adaptation: Adaptation) -> None:
        self._hand(lambda w: w.add_adaptation(adaptation))

    def add_weights(self, weights: AdaptedWeights, adaptation: Adaptation) -> None:
        self._hand(lambda w: w.add_weights(weights, adaptation))

    def mark(self, outcome: Outcome) -> None:
        self._hand(lambda w: w.mark(outcome))

    def event(self, name: str, text: str = "", detail: Mapping[str, Any] | None = None) -> None:
        self._hand(lambda w: w.event(name, text, detail))

    def end_trial(self, success: bool, attempts: int) -> None:
        self._hand(lambda w: w.end_trial(success, attempts))

    def close(self, reason: str = "") -> None:
        """Blocks until the disk has it all; raises nothing (`error` tells)."""
        if self._writer is not None:
            try:
                self._writer.close(reason)
            except RecordingError as error:
                self._error = error

    def _hand(self, call: Callable[[SessionWriter], None]) -> None:
        if self._writer is None or self.error is not None:
            return
        try:
            call(self._writer)
        except RecordingError as error:
            self._error = error
