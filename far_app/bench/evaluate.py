"""`far bench evaluate`: policy ticks a second of lockstep trials in one process, eight scenes side by side beside one
after the other; and where the time goes.

Random weights: an attempt runs to its horizon. A machine runs as many such processes as it has cores (`far eval
--workers`), so the targets for two cores are asked of one process by half.
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from far_app.bench.report import write
from far_app.bench.rows import Row, table
from far_app.errors import ConfigError
from far_app.tasks import task as find_task
from hw.rig import load_rig

TARGETS = {"state": 75.0, "quickstart": 15.0}
"""Policy ticks a second of one process."""


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """Policy ticks a second in lockstep, by preset."""

    presets: tuple[str, ...] = ("state", "quickstart")
    task: str = "lift"
    rig: str = "twin"
    ticks: int = 40
    """Of each attempt."""
    rounds: int = 3
    """Each round runs every scene once side by side and once one after the other."""
    json: Path | None = None
    """Write the report here."""

    def __post_init__(self) -> None:
        if self.ticks < 1 or self.rounds < 1:
            raise ConfigError(f"--ticks {self.ticks}, --rounds {self.rounds}: at least 1 each")


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(EvaluateOptions, args=list(arguments), prog="far bench evaluate")
    import torch

    os.environ.setdefault("LP_NUM_THREADS", "1")
    torch.set_num_threads(1)
    rows, shares = [], {}
    for preset in options.presets:
        row, shares[preset] = measure(preset, options)
        rows.append(row)
    write({"seconds_of_a_tick": shares, "rows": table(rows)}, options.json)
    return 0


class Stopwatch:
    """Seconds within calls, by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def around(self, owner: Any, method: str, name: str) -> None:
        """From now on each call of the owner's method is timed."""
        call = getattr(owner, method)

        def timed(*arguments: Any, **named: Any) -> Any:
            began = time.perf_counter()
            try:
                return call(*arguments, **named)
            finally:
                self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began

        setattr(owner, method, timed)


class Forever:
    """A method that never learns."""

    name = "nr"

    def __init__(self, policy: Any) -> None:
        self.policy = policy

    def begin(self, scene_seed: int) -> None: ...

    def adapt(self, attempt: Any, cancelled: Any, progress: Any) -> Any:
        raise AssertionError("a single attempt is never learnt from")

    def perturb(self, attempt_index: int, scene_seed: int) -> Any:
        return lambda tick: np.zeros(self.policy.spec.action_dim)


def measure(preset: str, options: EvaluateOptions) -> tuple[Row, dict[str, float]]:
    from far_app.cli.assemble import untrained
    from far_app.cli.lockstep_twin import LANES, lockstep_twins, trials
    from far_app.learning.runtime import ActingPolicy

    task = find_task(options.task, load_rig(options.rig).arm)
    task = dataclasses.replace(task, horizon=options.ticks, max_attempts=1)
    network, critic = untrained(preset, task.name, "cpu")
    robots = lockstep_twins(options.rig, task, LANES, bool(network.config.cameras))
    methods = [Forever(ActingPolicy(network, "bench", critic))] * LANES
    list(trials(range(LANES), robots, methods, task))  # warm-up
    watch = Stopwatch()
    for robot in robots:
        watch.around(robot.plant, "advance", "physics")
        watch.around(robot.controller, "tick", "controller")
    if robots[0].view is not None:
        watch.around(robots[0].view, "image", "drawing")
    watch.around(methods[0].policy, "plan", "inference")
    rates: dict[str, list[float]] = {"plain": [], "fast": []}
    parts: dict[str, float] = {}
    for number in range(options.rounds):
        scenes = range(LANES * (number + 1), LANES * (number + 2))
        for form, lanes in (("fast", LANES), ("plain", 1)):
            watch.seconds.clear()
            began = time.perf_counter()
            done = list(trials(scenes, robots[:lanes], methods[:lanes], task))
            seconds = time.perf_counter() - began
            ticks = sum(len(a.steps) for _, t in done for a in t.attempts)
            rates[form].append(ticks / seconds)
            if form == "fast":
                parts = {k: round(s / ticks, 5) for k, s in (watch.seconds | {"all": seconds}).items()}
    row = Row(
        what=f"{preset}, {LANES} scenes side by side against one at a time", unit="ticks/s", better="more",
        fast=round(float(np.median(rates["fast"])), 1), plain=round(float(np.median(rates["plain"])), 1),
        repeats=options.rounds * LANES * options.ticks, target=TARGETS.get(preset),
    )  # fmt: skip
    if robots[0].view is not None:
        robots[0].view.close()
    return row, parts
