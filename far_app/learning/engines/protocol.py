"""What an engine is, and what is known of one before it is built."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from jaxtyping import Float
from torch import Tensor

from far_app.errors import FarError
from far_app.learning.memory import Encode
from far_app.learning.policy import DiffusionPolicy
from far_app.protocols import History

Push = Callable[[Float[Tensor, "B H A"]], Float[Tensor, "B H A"]]
"""May move each denoising step's estimate of the clean chunks."""


class EngineError(FarError):
    """An engine that cannot be built here, or is not what the reference is."""


class Engine(Protocol):
    """One version of a policy's weights, ready to run. Not for several threads at once; tensors are on the network's
    device; nothing keeps gradients."""

    name: str
    version: str
    """Of the weights that run."""

    def encode(self, histories: Sequence[History]) -> Float[Tensor, "B F"]:
        """Features of observation histories, oldest first."""
        ...

    def another_encoder(self) -> Encode:
        """`encode` for another thread, while this engine goes on."""
        ...

    def sample(
        self, features: Float[Tensor, "B F"], noise: Float[Tensor, "B H A"], push: Push | None = None
    ) -> Float[Tensor, "B H A"]:
        """Chunks in [−1, 1] denoised from this noise."""
        ...

    def plan(
        self, histories: Sequence[History], noise: Float[Tensor, "B H A"]
    ) -> tuple[Float[Tensor, "B F"], Float[Tensor, "B H A"]]:
        """Both at once: (features, chunks)."""
        ...

    def adapted(self, network: DiffusionPolicy, version: str) -> Engine:
        """Another engine for the same encoder with this network's denoiser; this one goes on with its own. Quick
        enough for the arm's way home. Raises EngineError."""
        ...


Make = Callable[[DiffusionPolicy, str, bool], Engine]
"""From (network, version, each_alone): with `each_alone` pictures are encoded one by one, so that features do not
depend on what they are computed beside. Raises EngineError."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    name: str
    summary: str
    make: Make
    unusable: Callable[[DiffusionPolicy], str]
    """Why it cannot run this network on its device; "" when it can. Quick: nothing is built."""
    tolerance: float
    """Largest difference from the reference: of a chunk's entries (in [−1, 1]), and of features against their
    largest."""
    automatic: bool = True
    """Whether `auto` may take it; those of lower precision are asked for by name."""
