"""`far bench adapt`: seconds from a failed attempt to a new policy version, by stage, with the 30 Hz loop running.

Naive trials go on in the twin all along; meanwhile one failed attempt is learnt from again and again, in the background
thread a session would use. `homing` is what the same machine needs to take the arm home: the time there is.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from far_app.bench.loop import Unlearning, naive_session
from far_app.bench.report import write
from far_app.cli.options import RunOptions
from far_app.cli.settings import recommended
from far_app.cli.stage import stage
from far_app.errors import ConfigError
from far_app.session.adaptation import BackgroundAdaptation
from far_app.session.inbox import IntentInbox
from far_app.session.statistics import LoopStatistics, percentiles
from far_app.session_states import Intent
from far_app.types import Adaptation


@dataclass(frozen=True, kw_only=True)
class AdaptOptions:
    """Seconds from a failed attempt to a new policy version, by stage."""

    rounds: int = 5
    """Adaptations to measure."""
    policy: str | None = None
    """Policy checkpoint; the shipped quickstart model by default."""
    critic: Path | None = None
    """Critic checkpoint; the one beside the policy by default."""
    seed: int = 0
    torch_threads: int = 1
    attempt_seconds: float = 20.0
    """How long to run trials first, to see one fail."""
    json: Path | None = None
    """Write the report here."""

    def __post_init__(self) -> None:
        if self.rounds < 1:
            raise ConfigError(f"--rounds is {self.rounds}, must be at least 1")


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(AdaptOptions, args=list(arguments), prog="far bench adapt")
    write(measure(options), options.json)
    return 0


def measure(options: AdaptOptions) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="far-bench-") as recordings:
        run = RunOptions(
            seed=options.seed, policy=options.policy, critic=options.critic, method="far", headless=True, rerun=False,
            torch_threads=options.torch_threads, recordings=Path(recordings),
            retry=recommended(RunOptions.task, options.policy),
        )  # fmt: skip
        with stage(run) as stage_:
            method = stage_.parts.method
            _, failure, _ = naive_session(stage_, options.attempt_seconds)
            inbox, statistics = IntentInbox(), LoopStatistics()
            adaptations: list[Adaptation] = []
            seconds: list[float] = []
            ended = threading.Event()

            def learn() -> None:
                while len(seconds) < options.rounds and not ended.is_set():
                    method.begin(failure.scene_seed)
                    began = time.monotonic()
                    adaptation = BackgroundAdaptation(method, failure, limit=600.0)
                    while not adaptation.done() and not ended.is_set():
                        time.sleep(0.01)
                    if ended.is_set():
                        return adaptation.cancel(wait=True)
                    seconds.append(time.monotonic() - began)
                    adaptations.append(adaptation.result())
                return inbox.put(Intent.QUIT)

            learning = threading.Thread(target=learn, name="bench-learning", daemon=True)
            with stage_.session(stage_.writer(), inbox, statistics, method=Unlearning(method)) as session:
                learning.start()
                try:
                    session.run()
                finally:
                    ended.set()
                    learning.join()
    return {
        "rounds": options.rounds,
        "ticks": len(failure.steps),
        "status": sorted({a.status for a in adaptations}),
        "pairs": adaptations[-1].pairs,
        "seconds": percentiles(seconds),
        "stages": {k: float(np.median([a.seconds.get(k, 0.0) for a in adaptations])) for k in adaptations[-1].seconds},
        "homing": percentiles(statistics.homing),
    }
