"""What the recorder does on the disk, one call after the other, in its own thread. Every call may raise OSError.

Each takes first the monotonic time at which the session asked for it. While steps arrive nothing waits for the disk
itself (that may take seconds on a busy one, and SIGKILL would then cost them); an attempt's end does, and a trial's.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from far_app.errors import RecordingError
from far_app.recording.append_file import sync_file, sync_folder
from far_app.recording.attempt_file import AttemptFile
from far_app.recording.scene_file import SceneAccepted, write_scene
from far_app.recording.schema import AttemptHeader, RecordedEvent, SessionInfo
from far_app.recording.session_folder import (
    TrialsLog,
    attempt_name,
    free_bytes,
    make_session,
    trial_folder,
)
from far_app.recording.weights_file import weights_path, write_weights
from far_app.types import ActionChunk, Adaptation, AdaptationStep, AdaptedWeights, Attempt, Outcome, Step, TickTimes

_SPACE_CHECK_INTERVAL = 5.0
_LATE = 1.0
"""Seconds behind the session after which the log says so: a crash could then cost more than a second."""


class SessionFiles:
    def __init__(
        self,
        root: Path,
        info: SessionInfo,
        *,
        on_attempt_closed: Callable[[Path], None] | None,
        space_to_start: int,
        space_to_go_on: int,
    ) -> None:
        """Makes the folder, session.json and trials.jsonl. Raises RecordingError."""
        self.folder, self.header = make_session(root, info, space_to_start)
        self._on_attempt_closed = on_attempt_closed
        self._space_to_go_on = space_to_go_on
        self._file: AttemptFile | None = None
        self._unsynced: list[Path] = []
        """Closed files whose footers may not be on the disk yet."""
        self._next_space_check = 0.0
        self._late_told = False
        try:
            self._trials = TrialsLog(self.folder)
            self._trials.append("session_started", stamp=time.monotonic(), sync=True)
        except OSError as error:
            raise RecordingError(f"cannot record to {self.folder}: {error.strerror}; choose another folder") from error

    def begin_trial(self, stamp: float, trial: int, scene_seed: int, detail: Mapping[str, Any]) -> None:
        (self.folder / trial_folder(trial)).mkdir()
        self._trials.append("trial_started", stamp=stamp, trial=trial, detail={"scene_seed": scene_seed, **detail})

    def scene(self, stamp: float, trial: int, accepted: SceneAccepted) -> None:
        detail = write_scene(self.folder, trial, accepted)
        self._unsynced.extend(self.folder / name for name in detail["pictures"].values())
        self._trials.append("scene_matched", stamp=stamp, trial=trial, detail=detail)

    def begin_attempt(self, stamp: float, header: AttemptHeader) -> None:
        self.close_attempt()
        self._late_told = False
        name = attempt_name(header.trial, header.attempt)
        self._file = AttemptFile(self.folder / name, header, self.header.info.cameras)
        self._trials.append(
            "attempt_started", stamp=stamp, trial=header.trial, attempt=header.attempt,
            detail={"file": name, "scene_seed": header.scene_seed, "policy_version": header.policy_version,
                    "previous": header.previous},
        )  # fmt: skip

    def step(self, stamp: float, step: Step) -> None:
        self._note_lateness(stamp)
        self._open.step(step)

    def chunk(self, stamp: float, chunk: ActionChunk) -> None:
        self._open.chunk(chunk, stamp)

    def tick_times(self, stamp: float, times: TickTimes) -> None:
        self._open.tick_times(times)

    def end_attempt(self, stamp: float, attempt: Attempt) -> None:
        file, outcome = self._open, attempt.outcome
        file.final(attempt.final)
        file.outcome(outcome, stamp)
        file.sync()
        self._trials.append(
            "attempt_ended", stamp=stamp, trial=file.header.trial, attempt=file.header.attempt,
            detail={"success": outcome.success, "judged_by": outcome.judged_by, "note": outcome.note,
                    "steps": file.steps},
            sync=True,
        )  # fmt: skip

    def abandon_attempt(self, stamp: float, reason: str) -> None:
        file = self._open
        file.event(RecordedEvent(stamp=stamp, event="attempt_abandoned", text=reason))
        file.sync()
        self._trials.append(
            "attempt_abandoned", stamp=stamp, trial=file.header.trial, attempt=file.header.attempt, text=reason,
            detail={"steps": file.steps}, sync=True,
        )  # fmt: skip

    def adaptation_step(self, stamp: float, step: AdaptationStep) -> None:
        self._open.adaptation_step(step, stamp)

    def adaptation(self, stamp: float, adaptation: Adaptation) -> None:
        file = self._open
        file.adaptation(adaptation, stamp)
        file.flush()
        self._trials.append(
            "adapted", stamp=stamp, trial=file.header.trial, attempt=file.header.attempt, text=adaptation.note,
            detail={"status": adaptation.status, "base_version": adaptation.base_version,
                    "version": adaptation.version, "flagged": len(adaptation.flagged), "pairs": adaptation.pairs},
        )  # fmt: skip

    def weights(self, stamp: float, weights: AdaptedWeights, adaptation: Adaptation) -> None:
        file = self._open
        path = weights_path(file.path)
        size = write_weights(path, weights, adaptation, file.header)
        self._unsynced.append(path)
        self._trials.append(
            "weights_kept", stamp=stamp, trial=file.header.trial, attempt=file.header.attempt,
            detail={"file": str(path.relative_to(self.folder)), "version": weights.version, "parent": weights.parent,
                    "bytes": size},
        )  # fmt: skip

    def mark(self, stamp: float, outcome: Outcome, trial: int, attempt: int) -> None:
        file = self._file
        if file is not None and (file.header.trial, file.header.attempt) == (trial, attempt):
            file.outcome(outcome, stamp)
        self._trials.append(
            "outcome_marked", stamp=stamp, trial=trial, attempt=attempt, text=outcome.note,
            detail={"success": outcome.success, "judged_by": outcome.judged_by, "note": outcome.note},
        )  # fmt: skip

    def event(self, stamp: float, name: str, text: str, detail: Mapping[str, Any], trial: int, attempt: int) -> None:
        if self._file is not None:
            self._file.event(RecordedEvent(stamp=stamp, event=name, text=text, detail=detail))
        self._trials.append(name, stamp=stamp, trial=trial, attempt=attempt, text=text, detail=detail)

    def end_trial(self, stamp: float, trial: int, success: bool, attempts: int) -> None:
        self.close_attempt()
        self._sync()
        detail = {"success": success, "attempts": attempts}
        self._trials.append("trial_ended", stamp=stamp, trial=trial, detail=detail, sync=True)

    def flush(self) -> None:
        """To the kernel; now and then a look at the room that is left."""
        if self._file is not None:
            self._file.flush()
        now = time.monotonic()
        if now >= self._next_space_check:
            self._next_space_check = now + _SPACE_CHECK_INTERVAL
            self._check_space()

    def close_attempt(self) -> None:
        if self._file is not None:
            file, self._file = self._file, None
            file.close()
            self._unsynced.append(file.path)
            if self._on_attempt_closed is not None:
                self._on_attempt_closed(file.path)

    def end_session(self, stamp: float, reason: str) -> None:
        self.close_attempt()
        self._sync()
        self._trials.append("session_ended", stamp=stamp, text=reason, sync=True)

    def give_up(self, reason: str, intact: bool) -> None:
        """After an error: close what can be closed. `intact`: the attempt's file itself took no harm. Never raises."""
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(OSError):
                if intact:
                    file.event(RecordedEvent(stamp=time.monotonic(), event="recording_failed", text=reason))
                    file.close()
            file.let_go()
        with contextlib.suppress(OSError):
            self._trials.append("recording_failed", stamp=time.monotonic(), text=reason, sync=True)

    def refuse_more(self, stamp: float, reason: str) -> None:
        """The session's end after values were refused: the log must not say that all is here."""
        self.give_up(reason, intact=True)

    def close(self) -> None:
        self._trials.close()

    @property
    def _open(self) -> AttemptFile:
        assert self._file is not None, "no attempt's file is open"
        return self._file

    def _sync(self) -> None:
        """Closed files and the folders that name them to the disk itself."""
        for path in self._unsynced:
            sync_file(path)
            sync_folder(path.parent)
        self._unsynced.clear()
        sync_folder(self.folder)

    def _check_space(self) -> None:
        free = free_bytes(self.folder)
        if free < self._space_to_go_on:
            raise RecordingError(
                f"{free / 1e6:.0f} MB are left for recordings in {self.folder}, a session goes on down to "
                f"{self._space_to_go_on / 1e6:.0f} MB; free some space and start a new session"
            )

    def _note_lateness(self, stamp: float) -> None:
        late = time.monotonic() - stamp
        if late > _LATE and not self._late_told:
            self._late_told = True
            header = self._open.header
            self._trials.append(
                "recorder_late", stamp=stamp, trial=header.trial, attempt=header.attempt,
                text=f"the recorder was {late:.1f} s behind", detail={"seconds": late},
            )  # fmt: skip
