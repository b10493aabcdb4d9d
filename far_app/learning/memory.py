"""What was seen once is not encoded again: features by the observations they were computed from.

One memory is shared by the acting policy, the critic, attribution and the candidates of a run (`Ingredients.memory`):
the encoder is frozen while the application runs, so that features hold for every version of the weights. Observations
are known by identity and not kept alive.
"""

from __future__ import annotations

import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from far_app.protocols import History
from far_app.types import Observation

KEPT = 8192
"""Histories: some attempts of as many robots as plan together; a few MB."""

Encode = Callable[[Sequence[History]], Float[Tensor, "B F"]]


class FeatureMemory:
    """Features (F,) by history, the least recently used forgotten first. For any thread."""

    def __init__(self, kept: int = KEPT) -> None:
        self._room = kept
        self._known: OrderedDict[tuple[str, tuple[int, ...]], tuple[list[weakref.ref[Observation]], Tensor]] = (
            OrderedDict()
        )
        self._lock = threading.Lock()

    def copy(self) -> FeatureMemory:
        """Another one that knows the same so far."""
        other = FeatureMemory(self._room)
        with self._lock:
            other._known.update(self._known)
        return other

    def room_for(self, histories: int) -> None:
        """Keep at least so many."""
        self._room = max(self._room, histories)

    def of(self, histories: Sequence[History], encode: Encode, eyes: str = "policy") -> Float[Tensor, "B F"]:
        """Features of each history; `encode` is called once, with those not known yet, and not at all when all are.
        `eyes`: which encoder's."""
        found = [self._look(h, eyes) for h in histories]
        missing = {_identity(h): h for h, f in zip(histories, found, strict=True) if f is None}
        if missing:
            new = dict(zip(missing, encode(list(missing.values())), strict=True))
            self.keep(list(missing.values()), torch.stack(list(new.values())), eyes)
            found = [new[_identity(h)] if f is None else f for h, f in zip(histories, found, strict=True)]
        return torch.stack([f for f in found if f is not None])

    def known(self, histories: Sequence[History], eyes: str = "policy") -> bool:
        """Whether all of them are."""
        return all(self._look(h, eyes) is not None for h in histories)

    def keep(self, histories: Sequence[History], features: Float[Tensor, "B F"], eyes: str = "policy") -> None:
        with self._lock:
            for history, row in zip(histories, features, strict=True):
                self._known[eyes, _identity(history)] = ([weakref.ref(o) for o in history], row)
            while len(self._known) > self._room:
                self._known.popitem(last=False)

    def _look(self, history: History, eyes: str) -> Float[Tensor, "F"] | None:
        key = (eyes, _identity(history))
        with self._lock:
            references, features = self._known.get(key, ((), None))
            if features is None or any(r() is not o for r, o in zip(references, history, strict=True)):
                return None  # an address is used anew once its observation is gone
            self._known.move_to_end(key)
            return features


def _identity(history: History) -> tuple[int, ...]:
    return tuple(id(o) for o in history)
