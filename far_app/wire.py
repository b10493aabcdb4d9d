"""The wire format: versioned, typed, msgpack with raw array buffers. Never pickle.

A message is one registered frozen dataclass. Arrays travel as dtype, shape and bytes; enums as their values; unknown
names, fields, versions or array types are refused.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from enum import StrEnum
from typing import Any, TypeVar

import msgpack
import numpy as np

from far_app import protocols, types
from far_app.device_input import DeviceInput
from far_app.errors import FarError

WIRE_VERSION = 1

_T = TypeVar("_T", bound=type)

_CLASSES: dict[str, type] = {}
_FIELDS: dict[type, tuple[str, ...]] = {}
"""Of each of them."""
_ENUMS: dict[str, type[StrEnum]] = {}
_DTYPES = {"|u1", "<f4", "<f8", "<i4", "<i8", "|b1"}
_AS_THEY_ARE = frozenset((type(None), bool, int, float, str, bytes))
_MAX_BYTES = 64 * 2**20


class WireError(FarError):
    """A message that is not ours, damaged, or of another version."""


def register(cls: _T) -> _T:
    """Allow a frozen dataclass or a StrEnum on the wire, under its own name (a class decorator)."""
    if issubclass(cls, StrEnum):
        _ENUMS[cls.__name__] = cls
    else:
        _CLASSES[cls.__name__] = cls
        record: Any = cls
        _FIELDS[cls] = tuple(f.name for f in dataclasses.fields(record))
    return cls


for _cls in (
    types.Pose, types.RobotStatus, types.Target, types.Ack, types.Observation, types.ActionChunk, types.Outcome,
    types.RobotMode, types.Judge, types.AdaptationStep, types.Adaptation, types.Contrast, types.FlagCorrection,
    protocols.Reset, protocols.Home, protocols.Hold, protocols.Resume, protocols.Heartbeat, protocols.Guide,
    protocols.Frame,
    DeviceInput,
):  # fmt: skip
    register(_cls)


def pack(message: Any) -> bytes:
    """One registered value as bytes."""
    return _packed(_lower(message))


def _packed(lowered: Any) -> bytes:
    packed = msgpack.packb([WIRE_VERSION, lowered], use_bin_type=True)
    assert packed is not None, "packb always answers"
    return packed


class Packer:
    """`pack` for a stream of messages most of whose fields stay the same objects: those are lowered once. They must not
    be changed in place."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[Any, Any]] = {}

    def pack(self, message: Any) -> bytes:
        """One registered value as bytes, the same as `pack` makes."""
        kind, known = type(message), self._known
        if kind not in _FIELDS:
            return pack(message)
        inside = {}
        for name in _FIELDS[kind]:
            value = getattr(message, name)
            if type(value) in _AS_THEY_ARE:
                inside[name] = value
                continue
            if (before := known.get(name)) is None or before[0] is not value:
                before = known[name] = value, _lower(value)
            inside[name] = before[1]
        return _packed({"!": kind.__name__, "f": inside})


def unpack(raw: bytes) -> Any:
    """The value again; arrays are read-only views into the buffer. Raises WireError."""
    try:
        version, body = msgpack.unpackb(
            raw, raw=False, strict_map_key=False, max_bin_len=_MAX_BYTES, max_str_len=_MAX_BYTES
        )
    except (ValueError, TypeError, msgpack.UnpackException) as error:
        raise WireError(f"a message of {len(raw)} bytes is not in FAR's wire format: {error}") from error
    if version != WIRE_VERSION:
        raise WireError(f"wire version {version!r}, this program speaks {WIRE_VERSION}; update the older side")
    return _raise(body)


def _lower(value: Any) -> Any:
    """What msgpack takes. Telemetry passes here fifteen times a second in the loop's process: the usual kinds first."""
    kind = type(value)
    if kind in _AS_THEY_ARE:
        return value
    fields = _FIELDS.get(kind)
    if fields is not None:
        inside = {n: v if type(v := getattr(value, n)) in _AS_THEY_ARE else _lower(v) for n in fields}
        return {"!": kind.__name__, "f": inside}
    if kind is tuple or kind is list:
        return [_lower(v) for v in value]
    if kind is np.ndarray:
        array = np.ascontiguousarray(value)
        if array.dtype.str not in _DTYPES:
            raise WireError(f"arrays of {array.dtype} do not travel; choose one of {sorted(_DTYPES)}")
        return {"!nd": array.dtype.str, "s": list(array.shape), "b": array.tobytes()}
    if isinstance(value, StrEnum):
        if _ENUMS.get(kind.__name__) is not kind:
            raise WireError(f"{kind.__name__} is not registered for the wire")
        return {"!enum": kind.__name__, "v": value.value}
    if isinstance(value, bool | int | float | str | bytes):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        raise WireError(f"{kind.__name__} is not registered for the wire")
    if isinstance(value, tuple | list):
        return [_lower(v) for v in value]
    if isinstance(value, Mapping):
        return {"!map": [[_lower(k), _lower(v)] for k, v in value.items()]}
    raise WireError(f"a {kind.__name__} does not travel")


def _raise(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_raise(v) for v in value)
    if not isinstance(value, dict):
        return value
    try:
        if "!nd" in value:
            dtype, shape = value["!nd"], tuple(value["s"])
            if dtype not in _DTYPES:
                raise WireError(f"arrays of {dtype!r} are refused")
            return np.frombuffer(value["b"], dtype=dtype).reshape(shape)
        if "!enum" in value:
            return _ENUMS[value["!enum"]](value["v"])
        if "!map" in value:
            return {_raise(k): _raise(v) for k, v in value["!map"]}
        return _CLASSES[value["!"]](**{k: _raise(v) for k, v in value["f"].items()})
    except (KeyError, TypeError, ValueError) as error:
        raise WireError(f"a message with an unknown or malformed part: {error}") from error
