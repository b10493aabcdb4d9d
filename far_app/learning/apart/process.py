"""Work in a process of its own (server.py), from where it is asked for."""

from __future__ import annotations

import dataclasses
import json
import logging
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import zmq
from jaxtyping import Float
from torch import Tensor, nn

from far_app.config import FCPAConfig
from far_app.errors import FarError
from far_app.learning.apart.messages import (
    CandidatesAsked,
    NoLongerAsked,
    Progressed,
    UpdateAsked,
    UpdateMade,
    WorkFailed,
    endpoints,
    put,
    receive,
    send,
    weights_of,
)
from far_app.learning.apart.protocol import Key, Work
from far_app.learning.cancellation import Cancelled, check
from far_app.learning.fcpa import Update
from far_app.learning.pairs import Pairs
from far_app.learning.preference import Demonstrations
from far_app.learning.unet import ConditionalUnet1d
from far_app.types import AdaptationStep

log = logging.getLogger(__name__)

_LOOK_MS = 20
"""Between two looks whether somebody still waits."""


class WorkProcess:
    """Work. One computation at a time; what cannot be asked of the process, or of one that has ended, is made
    `instead`."""

    def __init__(self, folder: Path, ended: Callable[[], str | None], instead: Work) -> None:
        """`ended`: the process's last words once it has ended, or None. It may still be on its way up."""
        self._ended, self._instead = ended, instead
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        asked, told = endpoints(folder)
        self._asks, self._tells = self._context.socket(zmq.PUSH), self._context.socket(zmq.PULL)
        self._asks.connect(asked)  # which keeps what is sent until the process has come up
        self._tells.connect(told)
        self._seq = 0
        self._told = False
        """That it is gone."""
        self._lock = threading.Lock()

    def candidates(
        self, denoiser: nn.Module, ddim_steps: int, features: Float[Tensor, "S F"], noise: Float[Tensor, "S M H A"],
        cancelled: Cancelled,
    ) -> Float[Tensor, "S M H A"]:  # fmt: skip
        if not self._takes(denoiser) or not len(noise):
            return self._instead.candidates(denoiser, ddim_steps, features, noise, cancelled)
        tensors = {"denoiser": weights_of(denoiser), "features": features, "noise": noise}
        _, made = self._made(CandidatesAsked, tensors, cancelled, sizes=denoiser.sizes, ddim_steps=ddim_steps)
        return made["chunks"]

    def update(
        self, denoiser: nn.Module, pairs: Pairs, config: FCPAConfig, key: Key, cancelled: Cancelled,
        progress: Callable[[AdaptationStep], None], demonstrations: Demonstrations | None = None,
    ) -> Update:  # fmt: skip
        if not self._takes(denoiser):
            return self._instead.update(denoiser, pairs, config, key, cancelled, progress, demonstrations)
        history: list[AdaptationStep] = []

        def hear(step: AdaptationStep) -> None:
            history.append(step)
            progress(step)

        tensors = {
            "denoiser": weights_of(denoiser), "features": pairs.features, "negatives": pairs.negatives,
            "positives": pairs.positives, "owner": pairs.owner, "weights": pairs.weights,
        }  # fmt: skip
        if config.guard == "bc" and demonstrations is not None:
            tensors |= {"seen": demonstrations.features, "shown": demonstrations.chunks}
        done, made = self._made(
            UpdateAsked, tensors, cancelled, hear, sizes=denoiser.sizes, key=key,
            config=json.dumps(dataclasses.asdict(config)),
        )  # fmt: skip
        assert isinstance(done, UpdateMade)
        put(made["denoiser"], denoiser)
        return Update(status=done.status, changed=done.changed, history=tuple(history), note=done.note)

    def close(self) -> None:
        self._context.destroy(linger=0)

    def _takes(self, denoiser: nn.Module) -> bool:
        words = self._ended()
        if words is not None and not self._told:
            self._told = True
            log.warning("the learning process has ended (%s); learning goes on in this one", words or "it said nothing")
        on_cpu = next(denoiser.parameters()).device.type == "cpu"
        return words is None and isinstance(denoiser, ConditionalUnet1d) and on_cpu

    def _made(
        self, message: Callable[..., Any], tensors: Mapping[str, Tensor], cancelled: Cancelled,
        hear: Callable[[AdaptationStep], None] = lambda step: None, **fields: object,
    ) -> tuple[Any, dict[str, Tensor]]:  # fmt: skip
        """The answer to this message, and its tensors."""
        with self._lock:
            self._seq += 1
            send(self._asks, message(seq=self._seq, **fields), tensors)
            try:
                return self._answer(cancelled, hear)
            except BaseException:
                send(self._asks, NoLongerAsked(seq=self._seq))
                raise

    def _answer(
        self, cancelled: Cancelled, hear: Callable[[AdaptationStep], None]
    ) -> tuple[Any, dict[str, Tensor]]:  # fmt: skip
        while True:
            check(cancelled)
            if not self._tells.poll(_LOOK_MS):
                words = self._ended()
                if words is not None:
                    raise FarError(f"the learning process ended meanwhile: {words or 'it said nothing'}")
                continue
            told, tensors = receive(self._tells)
            if told.seq != self._seq:  # of a computation that nobody waited for
                continue
            if isinstance(told, Progressed):
                hear(told.step)
            elif isinstance(told, WorkFailed):
                raise FarError(told.error)
            else:
                return told, tensors
