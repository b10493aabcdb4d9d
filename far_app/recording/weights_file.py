"""Adapted weights beside the attempt they were learnt from: attempt_1.weights.safetensors.

A safetensors file of the denoiser, exact (float32), with its lineage in the header. Written by hand, one tensor after
the other from where it lies: nothing is copied, and the interpreter's lock is free while the kernel takes it. Read with
the safetensors package.
"""

from __future__ import annotations

import json
import os
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load_file

from far_app.errors import RecordingError
from far_app.recording.codec import encode_float
from far_app.recording.reader import SessionRecording
from far_app.recording.schema import AttemptHeader
from far_app.types import Adaptation, AdaptedWeights

FORMAT = "far-adapted-1"
_DTYPES = {"<f4": "F32", "<f8": "F64", "<f2": "F16", "<i8": "I64", "<i4": "I32", "|u1": "U8", "|b1": "BOOL"}


@dataclass(frozen=True, kw_only=True)
class Kept:
    """What the header of such a file says."""

    path: Path
    session: str
    task: str
    trial: int
    attempt: int
    """The failure it was learnt from."""
    version: str
    parent: str
    base: str
    """Fingerprint of the base policy."""
    status: str
    pairs: int
    winner_error: tuple[float, float]
    """l⁺ before the first and after the last step, on fixed draws."""
    loser_error: tuple[float, float]
    """l⁻, likewise."""
    size: int
    """Bytes."""


def weights_path(attempt: Path) -> Path:
    """Where the weights learnt from an attempt lie: beside its recording."""
    return attempt.with_suffix(".weights.safetensors")


def write_weights(path: Path, weights: AdaptedWeights, adaptation: Adaptation, header: AttemptHeader) -> int:
    """The file's bytes; whole or not at all (to the kernel: the disk itself is asked at the trial's end). Raises
    OSError."""
    history = adaptation.history
    metadata = {
        "format": FORMAT, "session": header.session, "task": header.task, "trial": str(header.trial),
        "attempt": str(header.attempt), "version": weights.version, "parent": weights.parent, "base": weights.base,
        "status": adaptation.status, "pairs": str(adaptation.pairs),
        "winner_error": json.dumps([encode_float(s.winner_error) for s in (history[:1] + history[-1:])]),
        "loser_error": json.dumps([encode_float(s.loser_error) for s in (history[:1] + history[-1:])]),
    }  # fmt: skip
    table: dict[str, object] = {"__metadata__": metadata}
    arrays, at = [], 0
    for name, tensor in weights.tensors.items():
        array = np.ascontiguousarray(tensor)
        arrays.append(array)
        where = [at, at + array.nbytes]
        table[name] = {"dtype": _DTYPES[array.dtype.str], "shape": list(array.shape), "data_offsets": where}
        at += array.nbytes
    head = json.dumps(table).encode()
    head += b" " * (-len(head) % 8)
    half = path.with_name(f".{path.name}.partial")
    try:
        with open(half, "wb", buffering=0) as file:
            for part in (struct.pack("<Q", len(head)), head, *(a.reshape(-1).view(np.uint8) for a in arrays)):
                view = memoryview(part)
                while view:
                    view = view[file.write(view) :]
        os.replace(half, path)
    except OSError:
        half.unlink(missing_ok=True)
        raise
    return 8 + len(head) + at


def read_kept(path: Path) -> Kept:
    """The header. Raises RecordingError when the file is damaged or of another kind."""
    try:
        with safe_open(path, framework="numpy") as file:
            known = file.metadata() or {}
        if known.get("format") != FORMAT:
            raise RecordingError(f"{path} holds format {known.get('format')!r}, adapted weights have {FORMAT!r}")
        return Kept(
            path=path, session=known["session"], task=known["task"], trial=int(known["trial"]),
            attempt=int(known["attempt"]), version=known["version"], parent=known["parent"], base=known["base"],
            status=known["status"], pairs=int(known["pairs"]), winner_error=_pair(known["winner_error"]),
            loser_error=_pair(known["loser_error"]), size=path.stat().st_size,
        )  # fmt: skip
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise RecordingError(f"{path} is truncated or no file of adapted weights ({error})") from error


def read_weights(path: Path) -> AdaptedWeights:
    """The weights again. Raises RecordingError when the file is damaged, missing or of another kind."""
    kept = read_kept(path)
    try:
        tensors = load_file(path)
    except (SafetensorError, OSError) as error:
        raise RecordingError(f"{path} cannot be read ({error})") from error
    return AdaptedWeights(version=kept.version, parent=kept.parent, base=kept.base, tensors=tensors)


def _pair(text: str) -> tuple[float, float]:
    values = [float("nan") if v is None else float(v) for v in json.loads(text)] or [float("nan")]
    return values[0], values[-1]


def kept_weights(session: SessionRecording) -> tuple[list[Kept], list[str]]:
    """Every version a session kept, in order, and a word on what cannot be read or is gone."""
    kept, problems = [], []
    for file in session.files:
        path = weights_path(file)
        if path.exists():
            try:
                kept.append(read_kept(path))
            except RecordingError as error:
                problems.append(str(error))
    names = [str(entry.detail.get("file")) for entry in session.log if entry.event == "weights_kept"]
    problems += [f"{session.path / name} is missing" for name in names if not (session.path / name).exists()]
    return kept, problems


def find_version(kept: list[Kept], version: str, session: Path) -> Kept:
    """The one of that name: "base+a1", or "3:base+a1" where several trials have one. Raises RecordingError that lists
    them."""
    found = [k for k in kept if version in (k.version, f"{k.trial}:{k.version}")]
    if len(found) == 1:
        return found[0]
    choices = ", ".join(f"{k.trial}:{k.version}" for k in (found or kept)) or "none"
    what = f"{len(found)} trials of {session} have a version" if found else f"{session} keeps no version"
    raise RecordingError(f"{what} '{version}'; choose one of: {choices}")
