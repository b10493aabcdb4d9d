"""What runs a policy's denoiser when it acts: torch, the reference, or OpenVINO, faster on CPU and optional.

Both take the same noise and give the same chunk (to 1e-4; a test holds them to it), so that an engine is a matter of
speed alone. Updates and large batches of candidates stay with torch.
"""

from __future__ import annotations

from typing import Literal, Protocol

from jaxtyping import Float, Int
from torch import Tensor, nn

from far_app.errors import ConfigError
from far_app.learning import openvino_unet
from far_app.learning.fast_unet import FastUnet
from far_app.learning.trainable import trainable

Engine = Literal["auto", "torch", "openvino"]
"""auto takes openvino where it is installed and fits the network, torch elsewhere."""


class Runner(Protocol):
    """A denoiser under fixed weights."""

    def condition(self, features: Float[Tensor, "S F"]) -> Tensor:
        """The observation's part, once a state."""
        ...

    def run(self, noisy: Float[Tensor, "B H A"], k: Int[Tensor, "B"], condition: Tensor) -> Float[Tensor, "B H A"]:
        """ε_θ(a_k, s, k), one row of `condition` each."""
        ...


def runner(denoiser: nn.Module, horizon: int, engine: Engine = "auto") -> Runner:
    """The denoiser's present weights behind an engine. ConfigError when openvino was asked for and cannot run it."""
    found = trainable(denoiser, horizon, train=False)
    if engine == "torch":
        return found
    usable = isinstance(found, FastUnet)
    if usable and openvino_unet.available():
        return openvino_unet.OpenVinoUnet(found)
    if engine == "openvino":
        reason = "the package is not installed; run pip install openvino" if usable else (
            "this network is not one it can run here (CPU, kernel 3); leave --engine out"
        )  # fmt: skip
        raise ConfigError(f"engine openvino was asked for, but {reason}")
    return found


def chosen(engine: Engine = "auto") -> str:
    """The engine a run on CPU would take, for people."""
    return "openvino" if engine != "torch" and openvino_unet.available() else "torch"
