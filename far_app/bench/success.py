"""`far bench success`: a learned success detector against the twin's own check, on recorded attempts it never saw.

An attempt is truly a success once the twin's check has held for the task's number of ticks. The detector is right on it
when it says so no earlier than the check began to hold (less a tenth of a second); on a failure when it says nothing.
Attempts: `far demo --policy FILE --linger 10`, on scenes that the detector was not made with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from far_app.bench.report import write
from far_app.cli.assemble import checkpoints
from far_app.errors import ConfigError
from far_app.statistics import wilson
from far_app.tasks import task as find_task

if TYPE_CHECKING:
    from far_app.learning.success import SuccessRule

EARLY = 3
"""Ticks before the check began to hold from which a claim is no longer premature."""


@dataclass(frozen=True, kw_only=True)
class SuccessOptions:
    """Balanced accuracy and false-success rate of a detector on held-out attempts."""

    detector: Path
    attempts: tuple[Path, ...]
    """HDF5 files of `far demo --policy … --linger 10`."""
    task: str = "lift"
    policy: Path | None = None
    """Checkpoint the detector was made for; the shipped one by default."""
    json: Path | None = None
    """Write the report here."""


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(SuccessOptions, args=list(arguments), prog="far bench success")
    import torch

    from far_app.learning.dataset import read_episodes
    from far_app.learning.policy import load_policy, trained_framings
    from far_app.learning.success import load_detector, read_card
    from far_app.learning.train_success import scores_of, watch

    torch.set_num_threads(1)
    path, _ = checkpoints(options.task, options.policy, None)
    policy = load_policy(path, options.task)
    detector = load_detector(options.detector, policy)
    config, framings, held = policy.config, trained_framings(path), find_task(options.task).success_ticks
    known: Any = read_card(options.detector).get("scenes", [])
    verdicts = []
    for file in options.attempts:
        episodes = read_episodes(file, config.cameras, None, config.image_size, framings)
        if overlap := {e.seed for e in episodes} & set(known):
            raise ConfigError(
                f"{len(overlap)} scenes of {file} were used to make {options.detector}; give attempts on other scenes"
            )
        for episode, watched in zip(episodes, watch(policy, episodes), strict=True):
            scores = scores_of(detector.head, watched.features)
            verdicts.append(verdict(scores, episode.successes, detector.rule, held))
    write(report(verdicts) | {"false_success_asked_for": detector.rule.false_success}, options.json)
    return 0


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What became of one attempt."""

    success: bool
    """The twin's own word."""
    claimed: bool
    """The detector said success, not before its time."""
    premature: bool
    """It said success well before there was one."""
    unsure: bool
    """It said nothing and would have asked the operator."""
    delay: float
    """Ticks from the twin's word to the detector's; NaN without both."""


def verdict(scores: np.ndarray, check: np.ndarray, rule: SuccessRule, held: int) -> Verdict:
    """The detector's word on an attempt of T ticks, given its scores (T,) and the twin's check (T,)."""
    from far_app.learning.success import agreed

    windows, truth = agreed(scores, rule.consecutive), agreed(check.astype(float), held)
    said = np.flatnonzero(windows > rule.threshold)
    true = np.flatnonzero(truth > 0)
    claim = int(said[0]) + rule.consecutive - 1 if len(said) else None
    premature = claim is not None and len(true) > 0 and claim < int(true[0]) - EARLY
    both = claim is not None and len(true) > 0
    return Verdict(
        success=len(true) > 0, claimed=claim is not None and not premature, premature=premature,
        unsure=claim is None and bool(len(windows)) and float(windows.max()) >= rule.lower,
        delay=float(claim - (int(true[0]) + held - 1)) if both and claim is not None else float("nan"),
    )  # fmt: skip


def report(verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """Rates with 95 % intervals (Wilson)."""
    good, bad = [v for v in verdicts if v.success], [v for v in verdicts if not v.success]
    if not good or not bad:
        raise ConfigError(f"{len(good)} successes and {len(bad)} failures: both are needed; record more attempts")
    delays = np.nanpercentile([v.delay for v in good if v.claimed] or [np.nan], (50, 95)).tolist()
    found, wrong = sum(v.claimed for v in good), sum(v.claimed for v in bad)
    return {
        "successes": len(good), "failures": len(bad),
        "balanced_accuracy": round((found / len(good) + 1 - wrong / len(bad)) / 2, 4),
        "found": {"count": found, "rate": round(found / len(good), 4), "interval": wilson(found, len(good))},
        "false_success": {"count": wrong, "rate": round(wrong / len(bad), 4), "interval": wilson(wrong, len(bad))},
        "premature": sum(v.premature for v in good),
        "unsure": {"successes": sum(v.unsure for v in good), "failures": sum(v.unsure for v in bad)},
        "delay_ticks": {"p50": delays[0], "p95": delays[1]},
    }  # fmt: skip
