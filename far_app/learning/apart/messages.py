"""What travels between an application and its learning process: a message of the wire format, then the tensors it goes
with, each a frame of its own that nobody copies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import zmq
from jaxtyping import Float
from torch import Tensor, nn

from far_app.learning.unet import UnetSizes
from far_app.types import AdaptationStep
from far_app.wire import WireError, pack, register, unpack


def endpoints(folder: Path) -> tuple[str, str]:
    """Where the process is asked and where it answers, in a run's folder."""
    return f"ipc://{folder}/asked", f"ipc://{folder}/told"


@register
@dataclass(frozen=True, kw_only=True)
class CandidatesAsked:
    """With `denoiser`, `features` and `noise`; answered with `chunks`."""

    seq: int
    sizes: UnetSizes
    ddim_steps: int


@register
@dataclass(frozen=True, kw_only=True)
class UpdateAsked:
    """With `denoiser`, the pairs' tensors, and where they are needed the demonstrations'; answered with `denoiser`."""

    seq: int
    sizes: UnetSizes
    config: str
    """FCPAConfig, as JSON."""
    key: tuple[int, ...]


@register
@dataclass(frozen=True, kw_only=True)
class NoLongerAsked:
    """Nobody waits for this answer."""

    seq: int


@register
@dataclass(frozen=True, kw_only=True)
class Progressed:
    seq: int
    step: AdaptationStep


@register
@dataclass(frozen=True, kw_only=True)
class CandidatesMade:
    seq: int


@register
@dataclass(frozen=True, kw_only=True)
class UpdateMade:
    seq: int
    status: str
    changed: bool
    note: str


@register
@dataclass(frozen=True, kw_only=True)
class WorkFailed:
    seq: int
    error: str


@register
@dataclass(frozen=True, kw_only=True)
class Beside:
    """The tensors that go with a message, in their frames' order."""

    names: tuple[str, ...]
    dtypes: tuple[str, ...]
    shapes: tuple[tuple[int, ...], ...]


_DTYPES = {"<f4": np.float32, "<i8": np.int64}


def send(socket: zmq.Socket[bytes], message: Any, tensors: Mapping[str, Tensor] | None = None) -> None:
    """The tensors must not change any more."""
    arrays = {name: tensor.detach().contiguous().numpy() for name, tensor in (tensors or {}).items()}
    beside = Beside(
        names=tuple(arrays), dtypes=tuple(a.dtype.str for a in arrays.values()),
        shapes=tuple(a.shape for a in arrays.values()),
    )  # fmt: skip
    socket.send_multipart([pack(message), pack(beside), *(a.data for a in arrays.values())], copy=False)


def receive(socket: zmq.Socket[bytes]) -> tuple[Any, dict[str, Tensor]]:
    """Raises WireError."""
    head, beside_, *frames = socket.recv_multipart(copy=False)
    message, beside = unpack(head.bytes), unpack(beside_.bytes)
    if not isinstance(beside, Beside) or len(beside.names) != len(frames) or not {*beside.dtypes} <= {*_DTYPES}:
        raise WireError(f"{type(message).__name__} came with other tensors than it names")
    arrays = zip(beside.names, beside.dtypes, beside.shapes, frames, strict=True)
    try:
        return message, {
            name: torch.from_numpy(np.frombuffer(frame.buffer, _DTYPES[dtype]).reshape(shape).copy())
            for name, dtype, shape, frame in arrays
        }
    except ValueError as error:
        raise WireError(f"a tensor of {type(message).__name__} is not what it is said to be: {error}") from error


def weights_of(module: nn.Module) -> Float[Tensor, "P"]:
    """All it consists of, flat; a copy."""
    return torch.cat([tensor.detach().flatten() for tensor in module.state_dict().values()])


def put(weights: Float[Tensor, "P"], module: nn.Module) -> None:
    """Such weights in place of its own."""
    into = list(module.state_dict().values())
    with torch.no_grad():
        for tensor, part in zip(into, weights.split([t.numel() for t in into]), strict=True):
            tensor.copy_(part.view(tensor.shape))
