"""`far bench train`: gradient steps a second of behaviour cloning, the plain form beside the fast one.

Both begin from the same weights and see the same batches and the same (k, ε), in turns; their losses are told too:
they are the same curve, or the fast form is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from far_app.bench.report import write
from far_app.bench.rows import REPEATS, Row, table, timed_side_by_side
from far_app.errors import ConfigError

EPISODES, TICKS = 20, 75
TARGET = 2.0
"""Times as many steps a second as the plain form."""


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Gradient steps a second, by preset."""

    presets: tuple[str, ...] = ("state", "quickstart")
    """`paper` too, where a step does not take seconds."""
    repeats: int = REPEATS
    device: str = "cpu"
    threads: int = 2
    """torch threads."""
    json: Path | None = None
    """Write the report here."""

    def __post_init__(self) -> None:
        if self.repeats < 1:
            raise ConfigError(f"--repeats is {self.repeats}, must be at least 1")


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(TrainOptions, args=list(arguments), prog="far bench train")
    import torch

    from far_app.cli.assemble import check_device

    check_device(options.device)
    torch.set_num_threads(options.threads)
    found = {preset: measure(preset, options) for preset in options.presets}
    if options.device == "cpu":  # a GPU's fast form is in bf16 already
        found |= {f"{p}, bf16": measure(p, options, low=True) for p in options.presets if looks(p)}
    report = {
        "device": options.device, "threads": options.threads,
        "largest_loss_difference": {preset: apart for preset, (_, apart) in found.items()},
        "rows": table([row for row, _ in found.values()]),
    }  # fmt: skip
    write(report, options.json)
    return 0


def looks(name: str) -> bool:
    """Whether a preset has cameras."""
    from far_app.learning.policy import preset

    return bool(preset(name, "lift").cameras)


def measure(name: str, options: TrainOptions, low: bool = False) -> tuple[Row, float]:
    """The row, and how far the two curves of the loss ever were apart, relative to the loss. `low`: the fast form has
    its camera networks in bf16."""
    import torch

    from far_app.learning.policy import preset
    from far_app.learning.policy_step import FastStep, LowStep, PlainStep
    from far_app.learning.segments import DemonstrationArrays
    from far_app.learning.train_policy import TRAININGS, begun

    config, training = preset(name, "lift"), TRAININGS[name]
    arrays = DemonstrationArrays(
        episodes(config.cameras, config.image_size, len(config.objects)), config, training.shift
    )
    quick = LowStep if low else FastStep
    losses: dict[type[PlainStep], list[float]] = {PlainStep: [], quick: []}

    def stepping(form: type[PlainStep]) -> Any:
        torch.manual_seed(0)
        step = begun(form, config, training, arrays, options.device)
        rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)

        def one() -> None:
            drawn = arrays.segments(training.batch // training.segment, training.segment, rng)
            loss = step.loss(drawn, generator, None)
            step.update(loss, training.lr, decay=0.9)
            losses[form].append(loss.item())

        return one

    plain, fast = timed_side_by_side(stepping(PlainStep), stepping(quick), options.repeats)
    apart = max(abs(a - b) / a for a, b in zip(losses[PlainStep], losses[quick], strict=True))
    per_second = [1e3 / float(np.median(ms)) for ms in (plain, fast)]
    row = Row(
        what=f"{name}, batch {training.batch} × {training.draws}" + ", cameras in bf16" * low, unit="steps/s",
        plain=round(per_second[0], 2), fast=round(per_second[1], 2), repeats=options.repeats,
        target=round(TARGET * per_second[0], 2), better="more",
    )  # fmt: skip
    return row, float(f"{apart:.2g}")


def episodes(cameras: Sequence[str], size: int, objects: int) -> list[Any]:
    """Noise in place of demonstrations: only the shapes count."""
    from far_app.learning.dataset import Episode

    rng = np.random.default_rng(0)
    return [
        Episode(
            images={c: rng.integers(0, 256, (TICKS, size, size, 3), np.uint8) for c in cameras},
            states=rng.normal(size=(TICKS, 8)).astype(np.float32),
            actions=rng.uniform(-1, 1, (TICKS, 7)).astype(np.float32), rewards=np.zeros(TICKS, np.float32),
            successes=np.zeros(TICKS, bool), success=True, seed=i,
            objects=rng.normal(size=(TICKS, 7 * max(1, objects))).astype(np.float32),
        )
        for i in range(EPISODES)
    ]  # fmt: skip
