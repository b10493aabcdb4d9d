"""Where an export goes: whole or not at all, and never over something that exists unless told so."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from far_app.errors import ConfigError, RecordingError


def check_target(path: Path, overwrite: bool) -> None:
    """ConfigError when something is there already and may not be replaced, or cannot sensibly be."""
    if path.exists() and not overwrite:
        raise ConfigError(f"{path} exists; give another --out, or --overwrite to replace it")
    for folder in (path, *path.parents):
        if (folder / "session.json").exists():
            raise ConfigError(
                f"{path} lies in the recording {folder}; a recording is never changed, give another --out"
            )


@contextmanager
def whole(path: Path, overwrite: bool = False) -> Iterator[Path]:
    """A path to write to (a file or a folder); what is there at the end takes the place of `path` at once, and after
    an error nothing is left. Raises ConfigError as check_target, RecordingError when it cannot be written."""
    check_target(path, overwrite)
    half = path.with_name(f".{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove(half)
        yield half
        if path.exists():
            old = path.with_name(f".{path.name}.old")
            _remove(old)
            os.replace(path, old)
            os.replace(half, path)
            _remove(old)
        else:
            os.replace(half, path)
    except OSError as error:
        what = error.strerror or str(error)
        raise RecordingError(f"cannot write {path}: {what}; free some space or choose another --out") from error
    finally:
        _remove(half)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
