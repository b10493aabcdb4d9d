"""A file that only grows. What flush() has handed to the kernel survives the death of this process."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path


class AppendFile:
    """A binary stream for one writer; refuses to open a file that exists."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC, 0o644)
        self._pending = bytearray()
        self._written = 0

    def write(self, data: bytes) -> int:
        self._pending += data
        return len(data)

    def tell(self) -> int:
        return self._written + len(self._pending)

    def flush(self) -> None:
        """Hand everything over in as few calls as the kernel allows. Raises OSError."""
        view = memoryview(bytes(self._pending))
        self._pending.clear()
        while view:
            done = os.write(self._fd, view)
            self._written += done
            view = view[done:]

    def sync(self) -> None:
        """Wait until it is on the disk itself (survives a power cut)."""
        os.fsync(self._fd)

    def lock(self) -> None:
        """Mark the file as being written by a living process; ends with the process."""
        fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def being_written(path: Path) -> bool:
    """Whether a living process holds the file's lock."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(fd)
    return False


def write_atomically(path: Path, data: bytes) -> None:
    """The whole file or none of it, on the disk when this returns. Raises OSError, leaving nothing behind."""
    half = path.with_name(f".{path.name}.partial")
    try:
        with open(half, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(half, path)
    except OSError:
        half.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def sync_file(path: Path) -> None:
    """Wait until the file is on the disk."""
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def sync_folder(folder: Path) -> None:
    """Wait until the folder's entries are on the disk."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
