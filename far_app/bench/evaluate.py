"""`far bench evaluate`: policy ticks a second of lockstep trials in one process, eight scenes side by side beside one
after the other, and where the time goes; then two processes at once beside one.

Random weights: an attempt runs to its horizon. A machine runs as many such processes as it has cores (`far eval
--workers`), so the targets for two cores are asked of one process by half. For two at once this module starts itself as
a process twice; each runs a round when it is told to.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from far_app.bench.report import write
from far_app.bench.rows import Row, table
from far_app.errors import ConfigError, FarError
from far_app.tasks import task as find_task
from hw.rig import load_rig

TARGETS = {"state": 75.0, "quickstart": 15.0}
"""Policy ticks a second of one process."""
SCALING = 0.9
"""Of twice one process's rate, what two at once should reach."""


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """Policy ticks a second in lockstep, by preset."""

    presets: tuple[str, ...] = ("state", "quickstart")
    task: str = "lift"
    rig: str = "twin"
    ticks: int = 40
    """Of each attempt."""
    rounds: int = 3
    """Each round runs every scene once side by side and once one after the other; then once in one process and in
    each of two."""
    json: Path | None = None
    """Write the report here."""

    def __post_init__(self) -> None:
        if self.ticks < 1 or self.rounds < 1:
            raise ConfigError(f"--ticks {self.ticks}, --rounds {self.rounds}: at least 1 each")


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(EvaluateOptions, args=list(arguments), prog="far bench evaluate")
    one_thread()
    rows, shares = [], {}
    for preset in options.presets:
        row, shares[preset] = measure(preset, options)
        rows += [row, scaling(preset, options)] if (os.cpu_count() or 1) > 1 else [row]
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


class Lockstep:
    """Lanes of a preset, warm."""

    def __init__(self, preset: str, options: EvaluateOptions) -> None:
        from far_app.cli.assemble import untrained
        from far_app.cli.lockstep_twin import LANES, lockstep_twins
        from far_app.learning.runtime import ActingPolicy

        task = find_task(options.task, load_rig(options.rig).arm)
        self.task = dataclasses.replace(task, horizon=options.ticks, max_attempts=1)
        self.lanes = LANES
        network, critic = untrained(preset, task.name, "cpu")
        self.robots = lockstep_twins(options.rig, self.task, LANES, bool(network.config.cameras))
        self.policy = ActingPolicy(network, "bench", critic)
        self.round(0)

    def round(self, number: int, lanes: int | None = None) -> tuple[int, float]:
        """A round's scenes side by side, or in fewer lanes; (ticks, seconds)."""
        from far_app.cli.lockstep_twin import trials

        robots = self.robots[:lanes]
        scenes = range(self.lanes * number, self.lanes * (number + 1))
        began = time.perf_counter()
        done = list(trials(scenes, robots, [Forever(self.policy)] * len(robots), self.task))
        seconds = time.perf_counter() - began
        return sum(len(a.steps) for _, t in done for a in t.attempts), seconds

    def close(self) -> None:
        for robot in self.robots:
            if robot.view is not None:
                robot.view.close()


def measure(preset: str, options: EvaluateOptions) -> tuple[Row, dict[str, float]]:
    lockstep, watch = Lockstep(preset, options), Stopwatch()
    for robot in lockstep.robots:
        watch.around(robot.plant, "advance", "physics")
        watch.around(robot.controller, "tick", "controller")
    if lockstep.robots[0].view is not None:
        watch.around(lockstep.robots[0].view, "image", "drawing")
    watch.around(lockstep.policy, "plan", "inference")
    rates: dict[str, list[float]] = {"plain": [], "fast": []}
    parts: dict[str, float] = {}
    for number in range(1, options.rounds + 1):
        for form, lanes in (("fast", None), ("plain", 1)):
            watch.seconds.clear()
            ticks, seconds = lockstep.round(number, lanes)
            rates[form].append(ticks / seconds)
            if form == "fast":
                parts = {k: round(s / ticks, 5) for k, s in (watch.seconds | {"all": seconds}).items()}
    lockstep.close()
    row = Row(
        what=f"{preset}, {lockstep.lanes} scenes side by side against one at a time", unit="ticks/s", better="more",
        fast=round(float(np.median(rates["fast"])), 1), plain=round(float(np.median(rates["plain"])), 1),
        repeats=options.rounds * lockstep.lanes * options.ticks, target=TARGETS.get(preset),
    )  # fmt: skip
    return row, parts


def scaling(preset: str, options: EvaluateOptions) -> Row:
    """Two processes at once against one, starting left out."""
    with contextlib.ExitStack() as stack:
        children = [stack.enter_context(child(preset, options)) for _ in range(2)]
        for each in children:
            answer(each)  # it is warm
        one, two, ticks = [], [], 0
        for number in range(1, options.rounds + 1):
            for rates, working in ((one, children[:1]), (two, children)):
                began = time.perf_counter()
                for each in working:
                    print(number, file=each.stdin, flush=True)
                done = sum(int(answer(each)) for each in working)
                rates.append(done / (time.perf_counter() - began))
                ticks += done
    alone, both = float(np.median(one)), float(np.median(two))
    return Row(
        what=f"{preset}, two processes at once against one", unit="ticks/s", better="more", fast=round(both, 1),
        plain=round(alone, 1), repeats=ticks, target=round(2 * SCALING * alone, 1),
    )  # fmt: skip


@contextlib.contextmanager
def child(preset: str, options: EvaluateOptions) -> Iterator[subprocess.Popen[str]]:
    """A process of this module; ends with the block."""
    words = [sys.executable, "-m", "far_app.bench.evaluate", preset, options.task, options.rig, str(options.ticks)]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        assert process.stdin is not None
        process.stdin.close()
        try:
            process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def answer(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise FarError("a process of the benchmark ended early; its words are above")
    return line


def serve(preset: str, task: str, rig: str, ticks: str) -> None:
    """The child: a round for each number that comes in, answered with its ticks."""
    one_thread()
    lockstep = Lockstep(preset, EvaluateOptions(task=task, rig=rig, ticks=int(ticks)))
    print("ready", flush=True)
    for line in sys.stdin:
        print(lockstep.round(int(line))[0], flush=True)
    lockstep.close()


def one_thread() -> None:
    import torch

    os.environ.setdefault("LP_NUM_THREADS", "1")
    torch.set_num_threads(1)


if __name__ == "__main__":
    serve(*sys.argv[1:])
