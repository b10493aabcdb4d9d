"""The recorder: the 30 Hz loop hands values over without waiting, one thread puts them on the disk.

    session loop ── add_step, add_chunk, … ──► bounded queue ──► recorder thread ──► attempt_k.mcap, trials.jsonl

What the loop has handed over is with the kernel at most FLUSH_INTERVAL later, so that SIGKILL loses less than a
second. The first error ends the recording: it goes to `on_error` and is raised by every later call, so that the
session holds the arm; nothing is ever dropped in silence.

The thread keeps the process's priority: at a lower one it was measured to be set aside by other processes while it
held the interpreter's lock, and the loop then waited for it (88 ms at the 99th percentile, against 7 ms, on two busy
cores). Encoding and compressing release the lock.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from far_app.errors import RecordingError
from far_app.recording.scene_file import SceneAccepted
from far_app.recording.schema import SCHEMA_VERSION, AttemptHeader, SessionInfo, json_schemas
from far_app.recording.session_files import SessionFiles
from far_app.recording.session_folder import SPACE_TO_GO_ON, SPACE_TO_START, attempt_name
from far_app.scheduling import SERVING_PRIORITY, real_time
from far_app.types import ActionChunk, Adaptation, AdaptationStep, AdaptedWeights, Attempt, Outcome, Step, TickTimes

log = logging.getLogger(__name__)

FLUSH_INTERVAL = 0.3
"""Seconds between two hand-overs to the kernel."""
QUEUE_LIMIT = 900
"""Values that may wait (more than ten seconds of an attempt) before the disk counts as too slow."""
CLOSE_LIMIT = 20.0
"""Seconds for which close() waits for the disk."""


@dataclass(frozen=True, kw_only=True)
class _Item:
    """One call of the session, waiting for the thread."""

    work: Callable[..., None]
    stamp: float
    arguments: tuple[Any, ...]


class SessionWriter:
    """Records one session. Every call comes from one thread (the session's), returns at once and may raise
    RecordingError; after that nothing more is recorded and close() is all that is left to do."""

    def __init__(
        self,
        root: Path,
        info: SessionInfo,
        *,
        on_error: Callable[[RecordingError], None] | None = None,
        on_attempt_closed: Callable[[Path], None] | None = None,
        space_to_start: int = SPACE_TO_START,
        space_to_go_on: int = SPACE_TO_GO_ON,
        queue_limit: int = QUEUE_LIMIT,
    ) -> None:
        """Makes the session's folder below root. Raises RecordingError (no room, no right to write). Both callbacks
        run in the recorder's thread and must return at once; on_attempt_closed gets a file that is whole."""
        json_schemas()  # now, not while the first attempt runs
        self._files = SessionFiles(
            root, info, on_attempt_closed=on_attempt_closed, space_to_start=space_to_start,
            space_to_go_on=space_to_go_on,
        )  # fmt: skip
        self.folder = self._files.folder
        """The session's folder."""
        self.header = self._files.header
        self._on_error = on_error
        self._queue_limit = queue_limit
        self._queue: queue.SimpleQueue[_Item | None] = queue.SimpleQueue()
        self._error: RecordingError | None = None
        self._told = False
        """Someone has heard of the error."""
        self._closed = False
        self._trial = 0
        self._scene_seed = 0
        self._method = info.method
        self._attempt = 0
        self._previous = ""
        self._last_tick: int | None = None
        """Tick of the newest step handed over, −1 before the first; None outside an attempt."""
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()
        log.info("recording to %s", self.folder)

    def begin_trial(self, trial: int, scene_seed: int, detail: Mapping[str, Any] | None = None) -> None:
        """`trial` counts from 1; `detail` is what a plan says of it (its `method` comes before the session's)."""
        self._trial, self._scene_seed, self._attempt, self._previous = trial, scene_seed, 0, ""
        self._method = str((detail or {}).get("method") or self.header.info.method)
        self._put(self._files.begin_trial, trial, scene_seed, dict(detail or {}))

    def add_scene(self, accepted: SceneAccepted) -> None:
        """How the real scene of the trial that has just begun looks; its arrays are not copied and must not change."""
        self._put(self._files.scene, self._trial, accepted)

    def begin_attempt(self, index: int, policy_version: str) -> None:
        """A new file, linked to the attempt before it, whose file is closed now."""
        assert self._trial > 0, "an attempt needs a trial: call begin_trial first"
        assert self._last_tick is None, f"attempt {self._attempt} of trial {self._trial} is still under way"
        header = AttemptHeader(
            schema_version=SCHEMA_VERSION, session=self.header.session, task=self.header.info.task,
            method=self._method, trial=self._trial, attempt=index, scene_seed=self._scene_seed,
            policy_version=policy_version, previous=self._previous,
            wall_minus_monotonic=self.header.wall_minus_monotonic,
        )  # fmt: skip
        self._attempt, self._previous, self._last_tick = index, attempt_name(self._trial, index), -1
        self._put(self._files.begin_attempt, header)

    def add_step(self, step: Step) -> None:
        """A completed step (Tick.step). A tick handed over before is passed over, so that a driver may give every
        Tick's step as it comes."""
        assert self._last_tick is not None, "a step needs an attempt: call begin_attempt first"
        if step.tick > self._last_tick:
            self._last_tick = step.tick
            self._put(self._files.step, step)

    def add_tick_times(self, times: TickTimes) -> None:
        """Where a tick of the running attempt spent its time, once that is known."""
        assert self._attempt > 0, "a tick's times need an attempt: call begin_attempt first"
        self._put(self._files.tick_times, times)

    def add_chunk(self, chunk: ActionChunk) -> None:
        """A chunk, as it became ready. Late ones are taken until the attempt's file is closed."""
        if self._attempt == 0:
            log.warning("the chunk of tick %d came after its attempt's file was closed: not recorded", chunk.tick)
            return
        self._put(self._files.chunk, chunk)

    def end_attempt(self, attempt: Attempt) -> None:
        """The steps not handed over yet, the final observation and the outcome. The file stays open for the
        adaptation until the next attempt begins or the trial ends."""
        for step in attempt.steps:
            self.add_step(step)
        self._last_tick = None
        self._put(self._files.end_attempt, attempt)

    def abandon_attempt(self, reason: str) -> None:
        """The attempt under way, if any, ends without an outcome (skipped, quit, a crash of the loop)."""
        if self._last_tick is not None:
            self._last_tick = None
            self._put(self._files.abandon_attempt, reason)

    def add_adaptation_step(self, step: AdaptationStep) -> None:
        """Progress of the running adaptation."""
        assert self._attempt > 0, "an adaptation needs the attempt it learns from: its trial has ended"
        self._put(self._files.adaptation_step, step)

    def add_adaptation(self, adaptation: Adaptation) -> None:
        """What the last attempt's failure taught."""
        assert self._attempt > 0, "an adaptation needs the attempt it learns from: its trial has ended"
        self._put(self._files.adaptation, adaptation)

    def add_weights(self, weights: AdaptedWeights, adaptation: Adaptation) -> None:
        """What the adaptation made, to a file beside its attempt's; the arrays are not copied and must not change."""
        assert self._attempt > 0, "weights need the attempt they were learnt from: its trial has ended"
        self._put(self._files.weights, weights, adaptation)

    def mark(self, outcome: Outcome, *, trial: int = 0, attempt: int = 0) -> None:
        """Someone's word on an attempt that has ended (the newest by default), beside the program's own judgment."""
        self._put(self._files.mark, outcome, trial or self._trial, attempt or self._attempt)

    def event(self, name: str, text: str = "", detail: Mapping[str, Any] | None = None) -> None:
        """Anything worth keeping that happens a few times a minute: pauses, faults, intents."""
        self._put(self._files.event, name, text, dict(detail or {}), self._trial, self._attempt)

    def end_trial(self, success: bool, attempts: int) -> None:
        """The trial's last file is closed."""
        self.abandon_attempt("the trial ended")
        self._put(self._files.end_trial, self._trial, success, attempts)
        self._trial = self._attempt = 0

    def close(self, reason: str = "") -> None:
        """Write what waits, close every file; blocks until the disk has it all. Raises a RecordingError of which
        nobody has heard yet. A second call does nothing."""
        if self._closed:
            return
        self._closed = True
        if self._last_tick is not None:
            self._enqueue(self._files.abandon_attempt, reason or "the session was closed")
        if self._error is None:
            self._enqueue(self._files.end_session, reason)
        else:
            self._enqueue(self._files.refuse_more, str(self._error))
        self._queue.put(None)
        self._thread.join(CLOSE_LIMIT)
        if self._thread.is_alive() and self._error is None:
            self._error = RecordingError(f"the disk did not take the recording within {CLOSE_LIMIT:.0f} s of closing")
        if self._error is not None and not self._told:
            self._told = True
            raise self._error

    @property
    def error(self) -> RecordingError | None:
        """Why nothing more is recorded."""
        return self._error

    @property
    def waiting(self) -> int:
        """Values not yet written."""
        return self._queue.qsize()

    def _put(self, work: Callable[..., None], *arguments: Any) -> None:
        assert not self._closed, "the recording is closed"
        if self._error is None and self._queue.qsize() >= self._queue_limit:
            self._error = RecordingError(
                f"the disk does not keep up: {self._queue.qsize()} values wait to be recorded, the limit is "
                f"{self._queue_limit}; record to a faster disk, or stop what else is writing to it"
            )
        if self._error is not None:
            self._told = True
            raise self._error
        self._enqueue(work, *arguments)

    def _enqueue(self, work: Callable[..., None], *arguments: Any) -> None:
        self._queue.put(_Item(work=work, stamp=time.monotonic(), arguments=arguments))

    def _run(self) -> None:
        """The thread: works the queue down, flushes in between, ends at None or at the first error."""
        real_time(SERVING_PRIORITY)
        due = time.monotonic() + FLUSH_INTERVAL
        try:
            while True:
                try:
                    item = self._queue.get(timeout=max(0.0, due - time.monotonic()))
                    if item is None:
                        break
                    item.work(item.stamp, *item.arguments)
                except queue.Empty:
                    pass
                if time.monotonic() >= due:
                    self._files.flush()
                    due = time.monotonic() + FLUSH_INTERVAL
        except Exception as error:
            self._give_up(error)
        finally:
            self._files.close()

    def _give_up(self, cause: Exception) -> None:
        """The first error of the thread: close what can be closed, tell the session."""
        if isinstance(cause, RecordingError):
            error, intact = cause, True
        elif isinstance(cause, OSError):
            what = cause.strerror or str(cause)
            error = RecordingError(f"cannot write to {self.folder}: {what}; free some space or choose another folder")
            intact = False
        else:
            error, intact = RecordingError(f"the recorder failed on a value it cannot record: {cause!r}"), True
            log.exception("the recorder failed")
        error.__cause__ = cause
        waiting = self._queue.qsize()
        self._files.give_up(f"{error} ({waiting} values were still waiting)", intact)
        self._error = self._error or error
        log.error("%s", error)
        if self._on_error is not None:
            self._told = True
            self._on_error(error)
