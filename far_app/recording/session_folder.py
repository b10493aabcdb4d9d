"""The folder of a session: its name, its layout, the room it needs, session.json and trials.jsonl."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from far_app.errors import RecordingError
from far_app.recording.append_file import AppendFile, sync_folder, write_atomically
from far_app.recording.codec import codec, plain
from far_app.recording.provenance import code_version, host_facts
from far_app.recording.schema import (
    SCHEMA_NAME,
    SCHEMA_VERSION,
    SESSION_FILE,
    TRIALS_FILE,
    LogEntry,
    SessionHeader,
    SessionInfo,
)

SPACE_TO_START = 500 * 10**6
"""Bytes that must be free before a session starts: about 200 attempts of 150 ticks with two cameras at 84 × 84,
or 30 whose adapted weights are kept beside (13.8 MB each with the quickstart policy)."""
SPACE_TO_GO_ON = 50 * 10**6
"""Bytes below which a running session ends while its files can still be closed."""


def free_bytes(folder: Path) -> int:
    """Bytes an unprivileged process may still write there."""
    facts = os.statvfs(folder)
    return facts.f_bavail * facts.f_frsize


def check_space(folder: Path, limit: int = SPACE_TO_START) -> None:
    """Raises RecordingError when fewer than `limit` bytes are free where the folder is, or will be, made."""
    existing = folder
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    try:
        free = free_bytes(existing)
    except OSError as error:
        raise RecordingError(f"cannot record to {folder}: {error.strerror}; choose another folder") from error
    if free < limit:
        raise RecordingError(
            f"{free / 1e6:.0f} MB are free for recordings in {folder}, at least {limit / 1e6:.0f} MB are needed; "
            "free some space or choose another folder"
        )


def trial_folder(trial: int) -> str:
    return f"trial_{trial:04d}"


def attempt_name(trial: int, attempt: int) -> str:
    """Path of an attempt's file, relative to the session's folder."""
    return f"{trial_folder(trial)}/attempt_{attempt}.mcap"


def wall_now() -> str:
    return datetime.now(UTC).astimezone().isoformat(timespec="milliseconds")


def make_session(root: Path, info: SessionInfo, limit: int) -> tuple[Path, SessionHeader]:
    """A new folder with its session.json. Raises RecordingError."""
    check_space(root, limit)
    started = datetime.now().astimezone()
    name = f"{started:%Y-%m-%d_%H-%M-%S}_{info.task}_{info.method}"
    try:
        root.mkdir(parents=True, exist_ok=True)
        folder = _new_folder(root, name)
        header = SessionHeader(
            schema=SCHEMA_NAME, schema_version=SCHEMA_VERSION, session=folder.name,
            started=started.isoformat(timespec="milliseconds"), wall_minus_monotonic=time.time() - time.monotonic(),
            code_version=code_version(), host=host_facts(), info=info,
        )  # fmt: skip
        text = json.dumps(codec(SessionHeader).encode(header), indent=2, ensure_ascii=False, allow_nan=False)
        write_atomically(folder / SESSION_FILE, f"{text}\n".encode())
        sync_folder(root)
    except OSError as error:
        raise RecordingError(
            f"cannot start a recording in {root}: {error.strerror}; choose another folder or free some space"
        ) from error
    return folder, header


def _new_folder(root: Path, name: str) -> Path:
    for suffix in ("", *(f"_{n}" for n in range(2, 1000))):
        folder = root / f"{name}{suffix}"
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise RecordingError(f"{root} holds a thousand sessions named {name}; choose another folder")


class TrialsLog:
    """trials.jsonl: one line an event, with the kernel when append returns."""

    def __init__(self, folder: Path) -> None:
        self._file = AppendFile(folder / TRIALS_FILE)
        self._file.lock()

    def append(
        self,
        event: str,
        *,
        stamp: float,
        trial: int = 0,
        attempt: int = 0,
        text: str = "",
        detail: Mapping[str, Any] | None = None,
        sync: bool = False,
    ) -> None:
        """With sync it and every line before it are on the disk itself when this returns, which may take long on a
        busy disk: never while steps arrive. Raises OSError."""
        entry = LogEntry(
            event=event, stamp=stamp, wall=wall_now(), trial=trial, attempt=attempt, text=text,
            detail=plain(detail or {}),
        )  # fmt: skip
        line = json.dumps(codec(LogEntry).encode(entry), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
        self._file.write(f"{line}\n".encode())
        self._file.flush()
        if sync:
            self._file.sync()

    def close(self) -> None:
        self._file.close()
