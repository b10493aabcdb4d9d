"""Reading an MCAP file that may be torn or damaged: every message that is sound, and a word on everything else.

The library's own reader stops at the first bad byte; this one goes on where it can and says what it passed over.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Footer, McapRecord, Message
from mcap.stream_reader import CRCValidationError, breakup_chunk
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError

from far_app.errors import RecordingError

_HEAD = struct.Struct("<BQ")
_FOOTER_BYTES = _HEAD.size + 8 + 8 + 4
_KNOWN = frozenset(int(opcode) for opcode in Opcode)
_LARGEST_CHUNK = 2**30
_DAMAGE = (McapError, CRCValidationError, ZstdError, struct.error, ValueError, UnicodeDecodeError, MemoryError)


@dataclass(frozen=True, kw_only=True)
class Scan:
    """One file, as far as it can be read."""

    messages: tuple[tuple[str, Message], ...]
    """Topic and message, in the file's order."""
    closed: bool
    """The footer is there: the writer finished this file."""
    damaged: bool
    """Bytes are there that cannot be trusted, beyond a torn end."""
    problems: tuple[str, ...]
    size: int
    """Bytes."""


def scan(path: Path) -> Scan:
    """Raises RecordingError only when there is no file or nothing of it is MCAP."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"cannot read {path}: {error.strerror}") from error
    if not raw.startswith(MCAP0_MAGIC):
        if MCAP0_MAGIC.startswith(raw):
            problem = f"the file ends after {len(raw)} bytes, before anything was recorded"
            return Scan(messages=(), closed=False, damaged=False, problems=(problem,), size=len(raw))
        raise RecordingError(f"{path} is not an MCAP file: it begins with {raw[:8]!r}")
    walk = _Walk(raw)
    records = list(walk.records())
    messages: list[tuple[str, Message]] = []
    channels = {record.id: record.topic for record in records if isinstance(record, Channel)}
    unknown = 0
    for record in records:
        if isinstance(record, Message):
            topic = channels.get(record.channel_id)
            if topic is None:
                unknown += 1
            else:
                messages.append((topic, record))
    if unknown:
        walk.damage(f"{unknown} messages belong to channels whose description is damaged")
    return Scan(
        messages=tuple(messages), closed=walk.closed, damaged=walk.damaged, problems=tuple(walk.problems),
        size=len(raw),
    )  # fmt: skip


def ends_in_order(path: Path) -> bool:
    """Whether the file ends as a finished one does; looks at its last bytes only."""
    with open(path, "rb") as file:
        file.seek(0, 2)
        file.seek(max(0, file.tell() - len(MCAP0_MAGIC)))
        return file.tell() > 0 and file.read() == MCAP0_MAGIC


class _Walk:
    """One pass over the bytes."""

    def __init__(self, raw: bytes) -> None:
        self.raw = raw
        self.closed = False
        self.damaged = False
        self.problems: list[str] = []
        self._footer = self._read_footer()

    def damage(self, problem: str) -> None:
        self.damaged = True
        self.problems.append(problem)

    def records(self) -> Iterator[McapRecord]:
        """Schemas, channels and messages, those within sound chunks too."""
        at = len(MCAP0_MAGIC)
        while at < len(self.raw):
            if self.raw[at:] == MCAP0_MAGIC:
                return
            end = self._record_end(at)
            if end is None:
                resumed = self._resume_after(at)
                if resumed is None:
                    self._torn(at)
                    return
                self.damage(f"bytes {at} to {resumed} are damaged and passed over")
                at = resumed
                continue
            opcode, body = self.raw[at], self.raw[at + _HEAD.size : end]
            if opcode == Opcode.CHUNK:
                yield from self._chunk(at, body)
            elif opcode == Opcode.CHANNEL:
                yield from self._channel(at, body)
            elif opcode == Opcode.DATA_END:
                self._check_data(at, body)
            elif opcode == Opcode.FOOTER:
                self.closed = self.raw[end:] == MCAP0_MAGIC
                self._check_summary(at, body)
                if not self.closed:
                    self._torn(end)
                return
            at = end

    def _record_end(self, at: int) -> int | None:
        """Where the record that begins here ends; None when no whole known record does."""
        if at + _HEAD.size > len(self.raw):
            return None
        opcode, length = _HEAD.unpack_from(self.raw, at)
        end = at + _HEAD.size + length
        return end if opcode in _KNOWN and end <= len(self.raw) else None

    def _chunk(self, at: int, body: bytes) -> Iterator[McapRecord]:
        try:
            chunk = Chunk.read(ReadDataStream(BytesIO(body)))
            if chunk.uncompressed_size > _LARGEST_CHUNK:
                raise ValueError(f"claims {chunk.uncompressed_size} bytes")
            yield from breakup_chunk(chunk, validate_crc=True)
        except _DAMAGE as error:
            self.damage(f"the chunk at byte {at} ({len(body)} bytes) is damaged and passed over: {error}")

    def _channel(self, at: int, body: bytes) -> Iterator[McapRecord]:
        """The summary repeats the channels, for when the chunk that introduced them is damaged."""
        try:
            yield Channel.read(ReadDataStream(BytesIO(body)))
        except _DAMAGE as error:
            self.damage(f"the channel record at byte {at} is damaged: {error}")

    def _check_data(self, at: int, body: bytes) -> None:
        [expected] = struct.unpack_from("<I", body) if len(body) >= 4 else [0]
        if expected and not self.damaged and zlib.crc32(self.raw[:at]) != expected:
            self.damage("the file's checksum is wrong though every chunk's is right: an index or a header is damaged")

    def _check_summary(self, at: int, body: bytes) -> None:
        if len(body) != _FOOTER_BYTES - _HEAD.size:
            return
        start, _, expected = struct.unpack("<QQI", body)
        if not 0 < start <= at or zlib.crc32(self.raw[start : at + _FOOTER_BYTES - 4]) != expected:
            self.damage("the index at the file's end is damaged; the messages do not depend on it")

    def _read_footer(self) -> Footer | None:
        start = len(self.raw) - _FOOTER_BYTES - len(MCAP0_MAGIC)
        if start < 0 or not self.raw.endswith(MCAP0_MAGIC) or self.raw[start] != Opcode.FOOTER:
            return None
        footer = Footer.read(ReadDataStream(BytesIO(self.raw[start + _HEAD.size :])))
        return footer if 0 < footer.summary_start < start else None

    def _resume_after(self, at: int) -> int | None:
        """The next chunk the index knows of, or the index itself; None without a sound one."""
        if self._footer is None or at >= self._footer.summary_start:
            return None
        starts = []
        position = self._footer.summary_start
        while (end := self._record_end(position)) is not None:
            if self.raw[position] == Opcode.CHUNK_INDEX:
                body = self.raw[position + _HEAD.size : end]
                try:
                    starts.append(ChunkIndex.read(ReadDataStream(BytesIO(body))).chunk_start_offset)
                except _DAMAGE:
                    return None
            position = end
        return min((start for start in starts if at < start < self._footer.summary_start),
                   default=self._footer.summary_start)  # fmt: skip

    def _torn(self, at: int) -> None:
        """No whole record begins here and nothing later can be found."""
        left = len(self.raw) - at
        head = self.raw[at : at + _HEAD.size]
        plausible = len(head) < _HEAD.size or (head[0] in _KNOWN and _HEAD.unpack(head)[1] < _LARGEST_CHUNK)
        problem = f"the last {left} bytes (from byte {at}) are no whole record"
        if plausible:
            self.problems.append(f"{problem}: the writer was cut off")
        else:
            self.damage(f"{problem}: they are damaged")
