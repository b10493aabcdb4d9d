"""`far bench precision`: does an engine of lower precision cost successes? The same scenes and noise under two engines.

One attempt a scene, in lockstep on the twin, by the policy alone; the difference is paired by scene.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from tqdm import tqdm

from far_app.bench.report import write
from far_app.config import RetryConfig
from far_app.errors import ConfigError
from far_app.evaluation import DEV_SCENES
from far_app.statistics import mcnemar, paired_difference
from hw.rig import load_rig


@dataclass(frozen=True, kw_only=True)
class PrecisionOptions:
    """Success under two engines on the same scenes."""

    engine: str = "openvino-bf16"
    against: str = "torch"
    """The engine it is compared with."""
    scenes: int = 200
    first_scene: int = DEV_SCENES
    task: str = "lift"
    policy: str | None = None
    """Policy checkpoint; the shipped quickstart model by default."""
    rig: str = "twin"
    json: Path | None = None
    """Write the report here."""

    def __post_init__(self) -> None:
        if self.scenes < 2:
            raise ConfigError(f"--scenes is {self.scenes}, must be at least 2")


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(PrecisionOptions, args=list(arguments), prog="far bench precision")
    write(measure(options), options.json)
    return 0


def measure(options: PrecisionOptions) -> dict[str, Any]:
    succeeded = {name: successes(options, name) for name in (options.engine, options.against)}
    left, right = succeeded[options.engine], succeeded[options.against]
    mean, low, high = paired_difference(left, right)
    only_left = sum(a and not b for a, b in zip(left, right, strict=True))
    only_right = sum(b and not a for a, b in zip(left, right, strict=True))
    return {
        "scenes": options.scenes, "success": {name: sum(s) / len(s) for name, s in succeeded.items()},
        "difference": mean, "interval_95": (low, high),
        "only": {options.engine: only_left, options.against: only_right},
        "mcnemar_p": mcnemar(only_left, only_right),
    }  # fmt: skip


def successes(options: PrecisionOptions, engine: str) -> list[bool]:
    """By scene."""
    import torch

    from far_app.cli.assemble import assemble
    from far_app.cli.lockstep_twin import LANES, lockstep_twins, trials
    from far_app.tasks import task as find_task

    torch.set_num_threads(1)
    task = dataclasses.replace(find_task(options.task, load_rig(options.rig).arm), max_attempts=1)
    lanes = min(LANES, options.scenes)
    parts = assemble("dp", task, options.policy, None, "cpu", RetryConfig(), engine, lanes)
    robots = lockstep_twins(options.rig, task, lanes, bool(parts.method.policy.spec.cameras))
    scenes = range(options.first_scene, options.first_scene + options.scenes)
    found: dict[int, bool] = {}
    bar = tqdm(total=len(scenes), unit="scene", desc=engine)
    for scene, trial in trials(scenes, robots, [parts.another() for _ in robots], task):
        found[scene] = trial.success
        bar.update()
    bar.close()
    return [found[scene] for scene in scenes]
