"""One attempt's file as typed values again. Tolerant of crashes and damage: says what is missing, repairs nothing.

Called by reader, and by whoever has one file in hand.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Message

from far_app.errors import RecordingError
from far_app.recording.codec import Json, decode
from far_app.recording.images import LazyImages, decode_png
from far_app.recording.migrations import migrated, readable
from far_app.recording.scan import Scan, scan
from far_app.recording.schema import (
    CAMERA_TOPIC,
    SCHEMA_VERSION,
    AttemptHeader,
    RecordedEvent,
)
from far_app.types import (
    ActionChunk,
    Adaptation,
    AdaptationStep,
    Attempt,
    Observation,
    Outcome,
    Step,
    TickTimes,
)


@dataclass(frozen=True, kw_only=True)
class AttemptRecording:
    """One attempt's file."""

    path: Path
    header: AttemptHeader | None
    """None when the file was cut off before it or it is damaged."""
    steps: tuple[Step, ...]
    """In the order of their ticks; frames are decoded when asked for."""
    chunks: tuple[ActionChunk, ...]
    tick_times: tuple[TickTimes, ...]
    """Where each tick's time went; empty in older recordings."""
    events: tuple[RecordedEvent, ...]
    final: Observation | None
    outcomes: tuple[Outcome, ...]
    """The program's own judgment first, then the marks made while the file was open."""
    adaptation_steps: tuple[AdaptationStep, ...]
    adaptation: Adaptation | None
    frames: dict[str, int]
    """Camera name to the number of readable frames."""
    abandoned: str
    """Why the attempt ended without an outcome (skipped, quit, recording failed); "" when it was not abandoned."""
    closed: bool
    """The writer finished the file."""
    damaged: bool
    """Bytes are there that cannot be trusted, beyond a torn end."""
    problems: tuple[str, ...]
    """What is missing or damaged, in words."""
    size: int
    """Bytes."""

    @property
    def outcome(self) -> Outcome | None:
        """The last word."""
        return self.outcomes[-1] if self.outcomes else None

    @property
    def duration(self) -> float:
        """Seconds from the first step's observation to the final one (or to the last step's)."""
        if not self.steps:
            return 0.0
        last = self.final.stamp if self.final is not None else self.steps[-1].stamp
        return last - self.steps[0].stamp

    def attempt(self) -> Attempt:
        """The value the loop handed over. Raises RecordingError when it never ended."""
        if self.header is None or self.final is None or self.outcome is None:
            why = "; ".join(self.problems) or f"it was abandoned: {self.abandoned}"
            raise RecordingError(f"{self.path} holds no ended attempt: {why}")
        return Attempt(
            index=self.header.attempt, scene_seed=self.header.scene_seed, steps=self.steps, final=self.final,
            outcome=self.outcome, policy_version=self.header.policy_version,
        )  # fmt: skip


def read_attempt(path: Path) -> AttemptRecording:
    """Raises RecordingError when there is no such file, it is not MCAP, or it is of another schema."""
    found = scan(path)
    parts = _Parts(path, found)
    return parts.recording()


@dataclass
class _Parts:
    """What the messages of one file amount to."""

    path: Path
    found: Scan
    header: AttemptHeader | None = None
    problems: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.problems.extend(self.found.problems)
        self._unreadable = 0
        self._by_topic: dict[str, list[Message]] = {}
        for topic, message in self.found.messages:
            self._by_topic.setdefault(topic, []).append(message)
        self._version = SCHEMA_VERSION  # of a file whose header is lost: what it lacks reads as the defaults
        for body in self._bodies("/attempt"):
            if isinstance(body, dict) and "schema_version" in body:
                self._version = readable(body["schema_version"], self.path)
                break
        headers = self._values("/attempt", AttemptHeader)
        self.header = headers[0] if headers else None
        self._frames = {
            topic.removeprefix(CAMERA_TOPIC): {message.sequence: message.data for message in messages}
            for topic, messages in self._by_topic.items()
            if topic.startswith(CAMERA_TOPIC)
        }
        self._missing_frames = 0

    def recording(self) -> AttemptRecording:
        steps = [self._step(message) for message in self._by_topic.get("/step", [])]
        steps = sorted((step for step in steps if step is not None), key=lambda step: step.tick)
        finals = [final for body in self._bodies("/final") if (final := self._observation(body)) is not None]
        outcomes = self._values("/outcome", Outcome)
        adaptations = self._values("/adaptation", Adaptation)
        chunks = self._values("/chunk", ActionChunk)
        times = self._values("/tick_times", TickTimes)
        events = self._values("/event", RecordedEvent)
        progress = self._values("/adaptation_step", AdaptationStep)
        abandonments = [event.text for event in events if event.event in ("attempt_abandoned", "recording_failed")]
        self._say_what_is_missing(steps, finals, outcomes, abandoned=bool(abandonments))
        return AttemptRecording(
            path=self.path, header=self.header, steps=tuple(steps), chunks=tuple(chunks), tick_times=tuple(times),
            events=tuple(events), final=finals[-1] if finals else None, outcomes=tuple(outcomes),
            adaptation_steps=tuple(progress), adaptation=adaptations[-1] if adaptations else None,
            abandoned=abandonments[-1] if abandonments else "",
            frames={camera: len(frames) for camera, frames in self._frames.items()}, closed=self.found.closed,
            damaged=self.found.damaged or self._unreadable > 0, problems=tuple(self.problems), size=self.found.size,
        )  # fmt: skip

    def _say_what_is_missing(
        self,
        steps: list[Step],
        finals: list[Observation],
        outcomes: list[Outcome],
        abandoned: bool,
    ) -> None:
        say = self.problems.append
        if self.header is None:
            say("the header is missing")
        gaps = sorted(set(range(steps[-1].tick + 1)) - {step.tick for step in steps}) if steps else []
        if gaps:
            say(f"{len(gaps)} steps are missing: ticks {_ranges(gaps)}")
        if self._missing_frames:
            say(f"{self._missing_frames} frames that steps refer to are missing")
        if self._unreadable:
            say(f"{self._unreadable} messages do not fit their schema")
        if not outcomes and not abandoned:
            say("the outcome is missing: the attempt was cut off")
        elif outcomes and not finals:
            say("the final observation is missing")
        if not self.found.closed:
            say("the file was not closed")

    def _bodies(self, topic: str) -> list[Json]:
        bodies = []
        for message in self._by_topic.get(topic, []):
            try:
                bodies.append(migrated(topic, json.loads(message.data), self._version))
            except (ValueError, KeyError, TypeError, AttributeError):
                self._unreadable += 1
        return bodies

    def _values(self, topic: str, record: Any) -> list[Any]:
        values = []
        for body in self._bodies(topic):
            try:
                values.append(decode(record, body, f"{self.path} {topic}"))
            except RecordingError:
                self._unreadable += 1
        return values

    def _step(self, message: Message) -> Step | None:
        what = f"{self.path} /step {message.sequence}"
        try:
            body = migrated("/step", json.loads(message.data), self._version)
            images = self._images(body["observation"].pop("frames"))
            step = decode(Step, body, what)
        except (ValueError, KeyError, TypeError, AttributeError, RecordingError):
            self._unreadable += 1
            return None
        return replace(step, observation=replace(step.observation, images=images))

    def _observation(self, body: Json) -> Observation | None:
        try:
            images = self._images(body.pop("frames"))
            return replace(decode(Observation, body, f"{self.path} /final"), images=images)
        except (KeyError, TypeError, AttributeError, RecordingError):
            self._unreadable += 1
            return None

    def _images(self, numbers: dict[str, int]) -> LazyImages:
        available: dict[str, Callable[[], np.ndarray]] = {}
        for camera, number in numbers.items():
            message = self._frames.get(camera, {}).get(number)
            if message is None:
                self._missing_frames += 1
            else:
                available[camera] = partial(_decode_frame, message)
        return LazyImages(available)


def _decode_frame(message: bytes) -> np.ndarray:
    return decode_png(base64.b64decode(json.loads(message)["data"]))


def _ranges(ticks: list[int]) -> str:
    """3, 4, 5, 9 as "3–5, 9"."""
    spans: list[list[int]] = []
    for tick in ticks:
        if spans and tick == spans[-1][1] + 1:
            spans[-1][1] = tick
        else:
            spans.append([tick, tick])
    return ", ".join(str(a) if a == b else f"{a}–{b}" for a, b in spans)
