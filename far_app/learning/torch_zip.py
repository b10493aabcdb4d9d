"""Tensors out of a .pth file without unpickling it.

A .pth file is a zip of raw storages and a small pickle that names them. Here that pickle is read as a list of opcodes
(pickletools) and only what a state dict needs is understood: dictionaries, strings, numbers, tuples and the one call
that puts a tensor together. Anything else is refused; nothing named in the file is ever imported or called.
"""

from __future__ import annotations

import math
import pickletools
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from far_app.errors import CheckpointError

STORAGES = {
    "torch FloatStorage": np.float32,
    "torch DoubleStorage": np.float64,
    "torch HalfStorage": np.float16,
    "torch LongStorage": np.int64,
    "torch IntStorage": np.int32,
}
REBUILD = "torch._utils _rebuild_tensor_v2"
ORDERED = "collections OrderedDict"
_MARK = object()


def read_state_dict(path: Path) -> dict[str, Tensor]:
    """Name to tensor. Raises CheckpointError when the file is no zip of tensors, or holds anything else."""
    try:
        with zipfile.ZipFile(path) as archive:
            root = next(n for n in archive.namelist() if n.endswith("/data.pkl"))[: -len("data.pkl")]
            found = _Reader(archive, root).run(archive.read(root + "data.pkl"))
    except (zipfile.BadZipFile, StopIteration, KeyError, ValueError, IndexError, TypeError, OSError) as error:
        raise CheckpointError(f"{path} is not a readable zip of tensors ({error}); download it again") from error
    if not isinstance(found, dict) or not all(isinstance(v, Tensor) for v in found.values()):
        raise CheckpointError(f"{path} holds more than named tensors; only plain state dicts are read")
    return found


class _Reader:
    """A machine for the few opcodes of a state dict."""

    def __init__(self, archive: zipfile.ZipFile, root: str) -> None:
        self.archive, self.root = archive, root
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}

    def run(self, program: bytes) -> Any:
        for opcode, argument, _ in pickletools.genops(program):
            if opcode.name == "STOP":
                return self.stack[-1]
            self._step(opcode.name, argument)
        raise ValueError("the pickle has no end")

    def _since_mark(self) -> list[Any]:
        index = len(self.stack) - 1 - next(i for i, v in enumerate(reversed(self.stack)) if v is _MARK)
        items = self.stack[index + 1 :]
        del self.stack[index:]
        return items

    def _step(self, name: str, argument: Any) -> None:
        stack = self.stack
        if name in ("PROTO", "FRAME"):
            return
        if name in ("BINUNICODE", "SHORT_BINUNICODE", "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "GLOBAL"):
            stack.append(argument)
        elif name == "NONE":
            stack.append(None)
        elif name in ("NEWTRUE", "NEWFALSE"):
            stack.append(name == "NEWTRUE")
        elif name == "MARK":
            stack.append(_MARK)
        elif name in ("EMPTY_TUPLE", "EMPTY_DICT"):
            stack.append(() if name == "EMPTY_TUPLE" else {})
        elif name == "TUPLE":
            stack.append(tuple(self._since_mark()))
        elif name in ("TUPLE1", "TUPLE2", "TUPLE3"):
            count = int(name[-1])
            items = tuple(stack[-count:])
            del stack[-count:]
            stack.append(items)
        elif name in ("BINPUT", "LONG_BINPUT"):
            self.memo[argument] = stack[-1]
        elif name == "MEMOIZE":
            self.memo[len(self.memo)] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            stack.append(self.memo[argument])
        elif name == "BINPERSID":
            stack.append(self._storage(stack.pop()))
        elif name == "REDUCE":
            arguments = stack.pop()
            stack.append(self._call(stack.pop(), arguments))
        elif name == "SETITEM":
            value, key = stack.pop(), stack.pop()
            stack[-1][key] = value
        elif name == "SETITEMS":
            items = self._since_mark()
            stack[-1].update(zip(items[::2], items[1::2], strict=True))
        elif name == "BUILD":
            stack.pop()  # a state dict's _metadata: nothing that a tensor needs
        else:
            raise ValueError(f"opcode {name} has no place in a state dict")

    def _storage(self, identity: Any) -> np.ndarray:
        _, kind, key, _, count = identity
        if kind not in STORAGES:
            raise ValueError(f"storage {kind!r} is not read")
        return np.frombuffer(self.archive.read(f"{self.root}data/{key}"), STORAGES[kind], count)

    @staticmethod
    def _call(function: Any, arguments: Any) -> Any:
        if function == ORDERED and arguments == ():
            return {}
        if function != REBUILD:
            raise ValueError(f"a call of {function!r} has no place in a state dict")
        storage, offset, shape, stride, *_ = arguments
        if len(shape) != len(stride) or offset < 0 or any(n < 0 for n in (*shape, *stride)):
            raise ValueError(f"a tensor of shape {shape} and stride {stride} at {offset}")
        last = offset + sum((n - 1) * s for n, s in zip(shape, stride, strict=True))
        if math.prod(shape) and last >= len(storage):
            raise ValueError(f"a tensor of shape {shape} reaches past its storage of {len(storage)}")
        return torch.as_strided(torch.from_numpy(storage.copy()), shape, stride, offset).contiguous()
