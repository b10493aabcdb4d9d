"""`far bench alarm`: what an early failure alarm would have saved and lost, on attempts that ran to their end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from tqdm import tqdm

from far_app.alarm import AlarmLimits, passed, read_limits
from far_app.bench.report import write
from far_app.cli.assemble import checkpoints
from far_app.cli.train_alarm import ALARM_SCENES, Heard, listen
from far_app.errors import ConfigError
from far_app.statistics import wilson


@dataclass(frozen=True, kw_only=True)
class AlarmOptions:
    """Time saved and successes lost on scenes that the limits were not set on."""

    alarm: Path
    """`far train alarm`'s file."""
    task: str = "lift"
    rig: str = "twin"
    policy: Path | None = None
    critic: Path | None = None
    scenes: int = 200
    first_scene: int = ALARM_SCENES + 5_000
    json: Path | None = None
    """Write the report here."""


def main(arguments: Sequence[str]) -> int:
    from far_app.learning.policy import fingerprint, load_policy

    options = tyro.cli(AlarmOptions, args=list(arguments), prog="far bench alarm")
    policy, critic = checkpoints(options.task, options.policy, options.critic)
    limits = read_limits(options.alarm, fingerprint(load_policy(policy, options.task)))
    scenes = range(options.first_scene, options.first_scene + options.scenes)
    heard = list(tqdm(listen(options.task, options.rig, policy, critic, scenes), total=len(scenes), unit="attempt"))
    write(report(heard, limits), options.json)
    return 0


def ended(attempt: Heard, limits: AlarmLimits) -> int | None:
    """The tick at which the alarm would have ended an attempt; None where it would have let it run."""
    return next((t for t, scores in enumerate(attempt.scores) if passed(*scores, limits)), None)


def report(heard: Sequence[Heard], limits: AlarmLimits) -> dict[str, Any]:
    """Rates with 95 % intervals (Wilson)."""
    good, bad = [h for h in heard if h.success], [h for h in heard if not h.success]
    if not good or not bad:
        raise ConfigError(f"{len(good)} successes and {len(bad)} failures: both are needed; take more --scenes")
    lost = sum(ended(h, limits) is not None for h in good)
    ends = [ended(h, limits) for h in bad]
    noticed = [e for e in ends if e is not None]
    saved = [len(h.scores) - e for h, e in zip(bad, ends, strict=True) if e is not None]
    return {
        "successes": len(good), "failures": len(bad), "asked_for": limits.false_alarm,
        "successes_lost": {"count": lost, "rate": round(lost / len(good), 4), "interval": wilson(lost, len(good))},
        "failures_noticed": {
            "count": len(noticed), "rate": round(len(noticed) / len(bad), 4), "interval": wilson(len(noticed), len(bad))
        },
        "noticed_at_tick": {"p50": float(np.median(noticed)) if noticed else None},
        "ticks_of_failures": sum(len(h.scores) for h in bad), "ticks_saved": sum(saved),
        "share_saved": round(sum(saved) / sum(len(h.scores) for h in bad), 3),
    }  # fmt: skip
