"""Work in this process, on threads that meet once a batch."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from far_app.config import FCPAConfig
from far_app.learning import diffusion, fcpa
from far_app.learning.apart.protocol import Key
from far_app.learning.cancellation import Cancelled, check
from far_app.learning.fcpa import Update
from far_app.learning.pairs import Pairs, candidates
from far_app.learning.preference import Demonstrations, Noising
from far_app.learning.threads import on_threads
from far_app.learning.trainable import Arrange, trainable
from far_app.seeding import generator
from far_app.types import AdaptationStep


class WorkHere:
    """Work."""

    def __init__(self, threads: int = 1, arrange: Arrange = trainable) -> None:
        """`threads`: that compute at once, on a CPU; `arrange`: how the denoiser is run, the quickest way or, to
        compare with, plainly."""
        self.threads, self.arrange = threads, arrange

    def candidates(
        self, denoiser: nn.Module, ddim_steps: int, features: Float[Tensor, "S F"], noise: Float[Tensor, "S M H A"],
        cancelled: Cancelled,
    ) -> Float[Tensor, "S M H A"]:  # fmt: skip
        runner = self.arrange(denoiser, noise.shape[2], train=False)

        def denoise(noisy: Tensor, k: Tensor, condition: Tensor) -> Tensor:
            check(cancelled)
            return runner.run(noisy, k, condition)

        def sample(condition: Tensor, start: Tensor) -> Tensor:
            return diffusion.ddim_sample(denoise, condition, start, ddim_steps)

        with torch.no_grad(), on_threads(self.threads) as each:
            return candidates(sample, runner.condition(features), noise, cancelled, each)

    def update(
        self, denoiser: nn.Module, pairs: Pairs, config: FCPAConfig, key: Key, cancelled: Cancelled,
        progress: Callable[[AdaptationStep], None], demonstrations: Demonstrations | None = None,
    ) -> Update:  # fmt: skip
        noising = Noising(add_noise=diffusion.add_noise, steps=diffusion.TRAIN_STEPS)
        with on_threads(self.threads) as each:
            return fcpa.adapt(
                denoiser, noising, pairs, config, generator("fcpa", *key), cancelled, progress, demonstrations,
                self.arrange, each,
            )  # fmt: skip
