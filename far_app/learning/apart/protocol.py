"""What a lesson asks for; the same to the bit wherever it is made."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from jaxtyping import Float
from torch import Tensor, nn

from far_app.config import FCPAConfig
from far_app.learning.cancellation import Cancelled
from far_app.learning.fcpa import Update
from far_app.learning.pairs import Pairs
from far_app.learning.preference import Demonstrations
from far_app.types import AdaptationStep

Key = tuple[int, ...]
"""(scene, attempt): what an update's random numbers are keyed by."""


class Work(Protocol):
    """Both raise AdaptationCancelledError once nobody waits any more, and FarError when they cannot be made."""

    def candidates(
        self, denoiser: nn.Module, ddim_steps: int, features: Float[Tensor, "S F"], noise: Float[Tensor, "S M H A"],
        cancelled: Cancelled,
    ) -> Float[Tensor, "S M H A"]:  # fmt: skip
        """M chunks of every state, denoised from the given noise."""
        ...

    def update(
        self, denoiser: nn.Module, pairs: Pairs, config: FCPAConfig, key: Key, cancelled: Cancelled,
        progress: Callable[[AdaptationStep], None], demonstrations: Demonstrations | None = None,
    ) -> Update:  # fmt: skip
        """FCPA on these pairs, in place; `denoiser` is the caller's private copy. After an error it is of no use."""
        ...
