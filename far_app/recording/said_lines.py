"""Lines that people add to a closed session: one JSON object a line, in trials.jsonl's form, only appended.

A recording is never rewritten; each kind of word has a file of its own (corrections.jsonl, marks.jsonl).
"""

from __future__ import annotations

import json
import os
from datetime import datetime
from pathlib import Path

from far_app.errors import RecordingError
from far_app.recording.codec import codec, decode
from far_app.recording.schema import LogEntry


def now() -> str:
    """The wall clock, ISO 8601 with the offset to UTC."""
    return datetime.now().astimezone().isoformat(timespec="milliseconds")


def append_line(file: Path, entry: LogEntry) -> None:
    """On the disk when it returns. Raises RecordingError."""
    line = json.dumps(codec(LogEntry).encode(entry), separators=(",", ":"), ensure_ascii=False) + "\n"
    try:
        with file.open("ab") as output:
            if output.tell() and not _ends_a_line(file):
                output.write(b"\n")  # a line that a crash cut off stays as it is; ours begins anew
            output.write(line.encode())
            output.flush()
            os.fsync(output.fileno())
    except OSError as error:
        raise RecordingError(
            f"cannot write {file}: {error.strerror}; copy the session to a folder you may write to"
        ) from error


def read_lines(file: Path) -> tuple[list[LogEntry], list[str]]:
    """What can be read of it, oldest first, and what cannot; nothing of a file that is not there."""
    try:
        lines = file.read_bytes().split(b"\n")
    except FileNotFoundError:
        return [], []
    except OSError as error:
        return [], [f"{file.name} cannot be read: {error.strerror}"]
    entries, problems = [], []
    for number, line in enumerate(lines, start=1):
        try:
            if line:
                entries.append(decode(LogEntry, json.loads(line), file.name))
        except (ValueError, RecordingError):
            problems.append(f"line {number} of {file.name} is damaged or cut off")
    return entries, problems


def _ends_a_line(file: Path) -> bool:
    with file.open("rb") as existing:
        existing.seek(-1, os.SEEK_END)
        return existing.read(1) == b"\n"
