"""`far train alarm`: limits of the early failure alarm, calibrated on a policy's own attempts in the twin."""

from __future__ import annotations

import dataclasses
import itertools
import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro
from tqdm import tqdm

from far_app.alarm import Listening, calibrated
from far_app.cli.assemble import assemble, checkpoints
from far_app.cli.lockstep_twin import LANES, lockstep_twins, side_by_side
from far_app.config import RetryConfig
from far_app.errors import ConfigError
from far_app.protocols import Method
from far_app.tasks import task as find_task
from hw.rig import load_rig

log = logging.getLogger(__name__)

ALARM_SCENES = 70_000
"""Scene seeds that limits are set on; the bench takes later ones."""


@dataclass(frozen=True, kw_only=True)
class TrainAlarmOptions:
    """How long a success may look like a failure: set on successes, so that few new ones are lost."""

    task: str = "lift"
    rig: str = "twin"
    policy: Path | None = None
    """The shipped quickstart model by default."""
    critic: Path | None = None
    """The one beside the policy by default."""
    successes: int = 100
    """Successful first attempts to calibrate on."""
    first_scene: int = ALARM_SCENES
    false_alarm: float = 0.05
    """Share of successes that may be lost, at most."""
    out: Path = Path("runs/alarm.json")

    def __post_init__(self) -> None:
        if not 0 < self.false_alarm < 1 or self.successes < 1:
            raise ConfigError(
                f"--false-alarm {self.false_alarm}, --successes {self.successes}: a share of 1, at least 1"
            )


@dataclass(frozen=True, kw_only=True)
class Heard:
    """One attempt that ran to its end with an alarm that only listens."""

    success: bool
    scores: Sequence[tuple[float, int]]
    """(unrest, stagnation) of every tick."""


def main(arguments: Sequence[str]) -> int:
    from far_app.learning.policy import fingerprint, load_policy

    options = tyro.cli(TrainAlarmOptions, args=list(arguments), prog="far train alarm")
    policy, critic = checkpoints(options.task, options.policy, options.critic)
    heard, solved = [], 0
    with tqdm(total=options.successes, unit="success") as bar:
        for attempt in listen(options.task, options.rig, policy, critic, itertools.count(options.first_scene)):
            heard.append(attempt)
            solved += attempt.success
            bar.update(attempt.success)
            if solved >= options.successes:
                break
    limits = calibrated(
        [h.scores for h in heard if h.success], options.false_alarm, fingerprint(load_policy(policy, options.task))
    )
    options.out.parent.mkdir(parents=True, exist_ok=True)
    limits.write(options.out)
    log.info("wrote %s", options.out)
    print(
        f"{options.out}: an attempt ends when its value has not risen for {limits.stagnation:g} ticks or its chunks "
        f"disagree by {limits.unrest:.3f} (from {solved} successes of {len(heard)} attempts)"
    )
    return 0


def listen(task_name: str, rig: str, policy: Path, critic: Path, scenes: Iterable[int]) -> Iterator[Heard]:
    """First attempts on these scenes, each as it ends."""
    import torch

    torch.set_num_threads(1)
    task = dataclasses.replace(find_task(task_name, load_rig(rig).arm), max_attempts=1)
    parts = assemble("nr", task, str(policy), critic, "cpu", RetryConfig(), lanes=LANES)
    robots = lockstep_twins(rig, task, LANES, bool(parts.method.policy.spec.cameras))
    methods, alarms, waiting = [parts.another() for _ in robots], [Listening() for _ in robots], iter(scenes)
    lanes: dict[int, int] = {}

    def cast(scene: int, lane: int) -> tuple[int, Method]:
        lanes.setdefault(scene, lane)
        return scene, methods[lane]

    for scene, result in side_by_side(lambda: next(waiting, None), robots, cast, task, alarms):
        if result.attempts:
            yield Heard(success=result.success, scores=alarms[lanes[scene]].attempts[-1])
