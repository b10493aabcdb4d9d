"""Typed values to JSON and back, and the JSON Schema that describes them; all three from the field annotations.

    float            number; NaN is null, ±∞ the strings "Infinity" and "-Infinity"
    1-d array        list
    2-d array        {"shape": [rows, columns], "values": [row after row]}
    3-d and more     {"dtype": "<f4", "shape": […], "data": base64 of the little-endian bytes}
    mapping          object; tuple: list; enum: its value; None: null
    image            not here (images.py)

The schemas keep to what common MCAP viewers accept: plain types, no lists of lists, every object with properties.
A field added later with a default reads as that default from older files.
"""

from __future__ import annotations

import ast
import base64
import dataclasses
import inspect
import itertools
import math
import textwrap
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from typing import Any

import numpy as np

from far_app.errors import RecordingError

Json = Any
"""What json.dumps takes: dict, list, str, int, float, bool, None."""

_INFINITIES = {"Infinity": math.inf, "-Infinity": -math.inf}
_DTYPES = ("<f4", "<f8", "<i4", "<i8", "|u1", "|b1")


@dataclass(frozen=True, kw_only=True)
class Codec:
    """How values of one annotation become JSON, come back, and are described."""

    encode: Callable[[Any], Json]
    decode: Callable[[Json], Any]
    schema: dict[str, Json]


def encode_float(value: float) -> Json:
    """A number, null for NaN, a word for ±∞."""
    value = float(value)
    if math.isfinite(value):
        return value
    return None if math.isnan(value) else ("Infinity" if value > 0 else "-Infinity")


def decode_float(value: Json) -> float:
    if value is None:
        return math.nan
    return _INFINITIES[value] if isinstance(value, str) else float(value)


@lru_cache(maxsize=256)
def codec(hint: Any) -> Codec:
    """The codec of an annotation. Raises TypeError for one that has no form on disk."""
    if hint is float:
        return Codec(encode=encode_float, decode=decode_float, schema={"type": "number", "nullable": True})
    if hint is bool:
        return Codec(encode=bool, decode=bool, schema={"type": "boolean"})
    if hint is int:
        return Codec(encode=int, decode=int, schema={"type": "integer"})
    if hint is str:
        return Codec(encode=str, decode=str, schema={"type": "string"})
    if hint is Any:
        return Codec(encode=plain, decode=lambda value: value, schema={})
    if isinstance(hint, type) and issubclass(hint, StrEnum):
        schema = {"type": "string", "enum": [member.value for member in hint]}
        return Codec(encode=lambda value: hint(value).value, decode=hint, schema=schema)
    if dataclasses.is_dataclass(hint):
        return _dataclass_codec(hint)
    if getattr(hint, "array_type", None) is np.ndarray or hint is np.ndarray:
        return _array_codec(len(getattr(hint, "dim_str", "N").split()))
    return _generic_codec(hint)


def _generic_codec(hint: Any) -> Codec:
    origin = typing.get_origin(hint)
    arguments = typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        kinds = [argument for argument in arguments if argument is not types.NoneType]
        if len(kinds) == 1 and len(arguments) == 2:
            inner = codec(kinds[0])
            return Codec(
                encode=lambda value: None if value is None else inner.encode(value),
                decode=lambda value: None if value is None else inner.decode(value),
                schema={**inner.schema, "nullable": True},
            )
    if origin is typing.Literal and all(isinstance(word, str) for word in arguments):
        return Codec(encode=str, decode=str, schema={"type": "string", "enum": list(arguments)})
    if origin is tuple:
        inner = codec(arguments[0])
        if all(argument is Ellipsis or argument == arguments[0] for argument in arguments):
            return Codec(
                encode=lambda value: [inner.encode(item) for item in value],
                decode=lambda value: tuple(inner.decode(item) for item in value),
                schema={"type": "array", "items": inner.schema},
            )
    if origin in (Mapping, dict) and arguments[0] is str:
        inner = codec(arguments[1])
        return Codec(
            encode=lambda value: {str(key): inner.encode(item) for key, item in value.items()},
            decode=lambda value: {key: inner.decode(item) for key, item in value.items()},
            schema={"type": "object", "properties": {}, "additionalProperties": inner.schema},
        )
    raise TypeError(f"{hint!r} has no form in a recording")


def _array_codec(dims: int) -> Codec:
    if dims == 1:
        return Codec(
            encode=lambda value: _encode_numbers(_checked(value, 1)),
            decode=_decode_numbers,
            schema={"type": "array", "items": {"type": "number", "nullable": True}},
        )
    if dims == 2:
        return Codec(
            encode=_encode_matrix,
            decode=lambda value: _decode_numbers(value["values"]).reshape(value["shape"]),
            schema={
                "type": "object",
                "properties": {
                    "shape": {"type": "array", "items": {"type": "integer"}},
                    "values": {"type": "array", "items": {"type": "number", "nullable": True}},
                },
            },
        )
    return Codec(
        encode=lambda value: _encode_packed(_checked(value, dims)),
        decode=_decode_packed,
        schema={
            "type": "object",
            "properties": {
                "dtype": {"type": "string"},
                "shape": {"type": "array", "items": {"type": "integer"}},
                "data": {"type": "string", "contentEncoding": "base64"},
            },
        },
    )


def _checked(value: Any, dims: int) -> np.ndarray:
    array = np.asarray(value)
    if array.ndim != dims:
        raise TypeError(f"an array of shape {array.shape} where {dims} dimensions are recorded")
    return array


def _encode_numbers(array: np.ndarray) -> list[Json]:
    numbers = array.tolist()
    if array.dtype.kind == "f" and not math.isfinite(sum(numbers)):  # a sum over few numbers: quicker than numpy
        return [encode_float(value) for value in numbers]
    return numbers


def _encode_matrix(value: Any) -> Json:
    array = _checked(value, 2)
    return {"shape": list(array.shape), "values": _encode_numbers(array.ravel())}


def _decode_numbers(value: list[Json]) -> np.ndarray:
    if any(item is None or isinstance(item, str) for item in value):
        return np.array([decode_float(item) for item in value])
    if value and isinstance(value[0], float):
        return np.array(value, dtype=np.float64)
    return np.array(value) if value else np.zeros(0)


def _encode_packed(array: np.ndarray) -> Json:
    array = np.ascontiguousarray(array)
    array = array.astype(array.dtype.newbyteorder("<"), copy=False)
    if array.dtype.str not in _DTYPES:
        raise TypeError(f"arrays of {array.dtype} are not recorded; choose one of {_DTYPES}")
    data = base64.b64encode(array.tobytes()).decode("ascii")
    return {"dtype": array.dtype.str, "shape": list(array.shape), "data": data}


def _decode_packed(value: Json) -> np.ndarray:
    if value["dtype"] not in _DTYPES:
        raise ValueError(f"arrays of {value['dtype']!r} are not recorded; known: {_DTYPES}")
    return np.frombuffer(base64.b64decode(value["data"]), dtype=value["dtype"]).reshape(value["shape"])


def _dataclass_codec(cls: Any) -> Codec:
    docs = field_docs(cls)
    hints = typing.get_type_hints(cls)
    fields = {f.name: codec(hints[f.name]) for f in dataclasses.fields(cls)}
    properties = {name: {**c.schema, "description": docs[name]} for name, c in fields.items()}

    def encode(value: Any) -> Json:
        return {name: c.encode(getattr(value, name)) for name, c in fields.items()}

    def decode(value: Json) -> Any:
        return cls(**{name: c.decode(value[name]) for name, c in fields.items() if name in value})

    written_by_dataclass = (cls.__doc__ or "").startswith(f"{cls.__name__}(")
    schema = {
        "type": "object",
        "title": cls.__name__,
        "description": "" if written_by_dataclass else " ".join((cls.__doc__ or "").split()),
        "properties": properties,
    }
    return Codec(encode=encode, decode=decode, schema=schema)


@lru_cache(maxsize=256)
def field_docs(cls: type) -> dict[str, str]:
    """Field name to the docstring written below the field, "" where there is none."""
    docs = {f.name: "" for f in dataclasses.fields(cls)}
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(cls)))
    except (OSError, SyntaxError):
        return docs
    assert isinstance(tree.body[0], ast.ClassDef)
    body = tree.body[0].body
    for statement, after in itertools.pairwise(body):
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            text = after.value if isinstance(after, ast.Expr) else None
            if isinstance(text, ast.Constant) and isinstance(text.value, str):
                docs[statement.target.id] = " ".join(text.value.split())
    return docs


def plain(value: Any) -> Json:
    """Settings as JSON: dataclasses become objects, enums their values, paths strings."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, StrEnum):
        return value.value
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list | set | frozenset):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return encode_float(value)
    if value is None or isinstance(value, bool | int | str):
        return value
    if hasattr(value, "__fspath__"):
        return str(value)
    raise TypeError(f"a {type(value).__name__} has no form in a recording")


def decode(hint: Any, value: Json, what: str) -> Any:
    """A value of that annotation. Raises RecordingError when the JSON does not fit it."""
    try:
        return codec(hint).decode(value)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise RecordingError(f"{what} does not fit its schema: {error!r}") from error
