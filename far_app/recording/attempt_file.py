"""One attempt as one MCAP file: JSON messages with their schemas, small CRC-checked chunks, append-only.

    begin → (step | chunk | event)* → ended | abandoned → (adaptation …)* → close        flush() at any time

Only the recorder's thread touches it.
"""

from __future__ import annotations

import base64
import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from mcap.writer import CompressionType, Writer

from far_app.recording.append_file import AppendFile, sync_folder
from far_app.recording.codec import Json, codec
from far_app.recording.images import stored_png
from far_app.recording.schema import (
    CAMERA_TOPIC,
    SCHEMA_NAME,
    TOPICS,
    AttemptHeader,
    CompressedImage,
    CompressedImageTime,
    RecordedEvent,
    json_schemas,
)
from far_app.types import ActionChunk, Adaptation, AdaptationStep, Observation, Outcome, Step, TickTimes

_NEVER = 2**40
"""Bytes after which the library itself would cut a chunk; we cut one at each flush."""


class AttemptFile:
    def __init__(self, path: Path, header: AttemptHeader, cameras: tuple[str, ...]) -> None:
        """Creates the file; the header and every known channel are with the kernel when this returns. Raises OSError,
        FileExistsError too: nothing is ever overwritten."""
        self.path = path
        self.header = header
        self.steps = 0
        self._last_frames: dict[str, tuple[int, np.ndarray]] = {}
        """Camera name to the number of its newest frame and the frame."""
        self._stream = AppendFile(path)
        self._writer = Writer(
            self._stream,  # pyright: ignore[reportArgumentType] - writes, tells and flushes, which is all it needs
            chunk_size=_NEVER, compression=CompressionType.ZSTD, enable_data_crcs=True,
        )  # fmt: skip
        self._writer.start(profile="", library=SCHEMA_NAME)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        for topic in TOPICS:
            schema = json.dumps(json_schemas()[topic.name], ensure_ascii=False).encode()
            self._schemas[topic.name] = self._writer.register_schema(topic.schema_name, "jsonschema", schema)
            if not topic.name.startswith(CAMERA_TOPIC):
                self._channels[topic.name] = self._channel(topic.name, topic.name)
        for camera in cameras:
            self._camera_channel(camera)
        self._write("/attempt", AttemptHeader, header, time.monotonic())
        self.flush()

    def step(self, step: Step) -> None:
        self._write_json("/step", self._lower_step(step), step.deadline, step.tick)
        self.steps += 1

    def chunk(self, chunk: ActionChunk, stamp: float) -> None:
        self._write("/chunk", ActionChunk, chunk, stamp, chunk.tick)

    def tick_times(self, times: TickTimes) -> None:
        self._write("/tick_times", TickTimes, times, times.stamp, times.tick)

    def event(self, event: RecordedEvent) -> None:
        self._write("/event", RecordedEvent, event, event.stamp)

    def final(self, observation: Observation) -> None:
        self._write_json("/final", self._lower_observation(observation), observation.stamp)

    def outcome(self, outcome: Outcome, stamp: float) -> None:
        self._write("/outcome", Outcome, outcome, stamp)

    def adaptation_step(self, step: AdaptationStep, stamp: float) -> None:
        self._write("/adaptation_step", AdaptationStep, step, stamp, step.step)

    def adaptation(self, adaptation: Adaptation, stamp: float) -> None:
        self._write("/adaptation", Adaptation, adaptation, stamp)

    def flush(self) -> None:
        """Everything so far to the kernel, as one CRC-checked chunk. Raises OSError."""
        self._writer.flush()

    def sync(self) -> None:
        """Everything so far to the disk itself; never while steps arrive, for it may take long."""
        self.flush()
        self._stream.sync()
        sync_folder(self.path.parent)

    def close(self) -> None:
        """Index and footer, to the kernel; then the file never changes again."""
        self._writer.finish()
        self._stream.flush()
        self._stream.close()

    def let_go(self) -> None:
        """Close what could not be written to the end; it stays as it is."""
        self._stream.close()

    @property
    def size(self) -> int:
        """Bytes."""
        return self._stream.tell()

    def _lower_step(self, step: Step) -> Json:
        bare = replace(step, observation=replace(step.observation, images={}))
        lowered = codec(Step).encode(bare)
        lowered["observation"] = self._lower_observation(step.observation, lowered["observation"])
        return lowered

    def _lower_observation(self, observation: Observation, lowered: Json = None) -> Json:
        if lowered is None:
            lowered = codec(Observation).encode(replace(observation, images={}))
        del lowered["images"]
        stamp = observation.stamp
        lowered["frames"] = {name: self._frame(name, image, stamp) for name, image in observation.images.items()}
        return lowered

    def _frame(self, camera: str, image: np.ndarray, stamp: float) -> int:
        """The frame's number; written unless it is the camera's newest already."""
        number, newest = self._last_frames.get(camera, (-1, None))
        if newest is not None and (newest is image or np.array_equal(newest, image)):
            return number
        number += 1
        log_time = self._log_time(stamp)
        message = CompressedImage(
            timestamp=CompressedImageTime(sec=log_time // 10**9, nsec=log_time % 10**9), frame_id=camera,
            data=base64.b64encode(stored_png(image)).decode("ascii"), format="png",
        )  # fmt: skip
        self._camera_channel(camera)
        self._write(CAMERA_TOPIC + camera, CompressedImage, message, stamp, number)
        self._last_frames[camera] = (number, image)
        return number

    def _camera_channel(self, camera: str) -> None:
        topic = CAMERA_TOPIC + camera
        if topic not in self._channels:
            self._channels[topic] = self._channel(topic, CAMERA_TOPIC + "<name>")

    def _channel(self, topic: str, schema: str) -> int:
        return self._writer.register_channel(topic, "json", self._schemas[schema])

    def _write(self, topic: str, record: Any, value: Any, stamp: float, sequence: int = 0) -> None:
        self._write_json(topic, codec(record).encode(value), stamp, sequence)

    def _write_json(self, topic: str, lowered: Json, stamp: float, sequence: int = 0) -> None:
        raw = msgspec.json.encode(lowered)
        log_time = self._log_time(stamp)
        self._writer.add_message(self._channels[topic], log_time, raw, log_time, sequence)

    def _log_time(self, stamp: float) -> int:
        """Nanoseconds since 1970 of a monotonic stamp."""
        stamp = stamp if math.isfinite(stamp) else time.monotonic()
        return max(0, round((stamp + self.header.wall_minus_monotonic) * 1e9))
