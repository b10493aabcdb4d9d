"""Which settings of retrying a command begins from: those that the checkpoint's makers measured, or the paper's.

A policy NAMEpolicy.safetensors may have a NAMEretry.toml beside it, with what measured best for it; everything else is
the paper's value, and an option given on the command line comes before both.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import tyro

from far_app.cli.assemble import UNTRAINED, shipped
from far_app.config import RetryConfig, from_table
from far_app.errors import ConfigError

Settings = Literal["model", "paper"]
STEP_SIZES = {"state": "1e-4", "quickstart": "3e-5"}
"""fcpa.lr by preset: `state` was measured on all six tasks, `quickstart` on `lift`."""
EXPLORE = 0.15
"""pairs.explore where an action is one control step; one that is repeated moves the hand that much farther."""
MEASURED_BEST = """\
# What measured best for the preset `{preset}` (docs/results/README.md), chosen on development scenes but for the last
# line; all else is the paper's.
[pairs]
explore = {explore}        # candidates are moved by a translation each, and Q chooses among them
d_min = 0.0           # positives may lie near the negative (the paper: the mean distance), …
d_max = 100.0         # … or far from it (the paper: 1.0)

[fcpa]
lr = {lr}             # the paper: 1e-5
guard = "bc"          # demonstrations hold the rest of the policy in place
bc_weight = 0.1
accumulate = false    # every retry starts from the base, with all of the trial's pairs

[perturbation]
first_attempt = 3     # the first retry acts as what was learnt says; later ones explore too (the paper: all retries)
"""
Options = TypeVar("Options")


def recommended(task: str, policy: str | Path | None) -> RetryConfig:
    """What lies beside a checkpoint (the shipped one by default); the paper's settings where nothing does."""
    if policy is not None and str(policy).startswith((UNTRAINED, "test:")):
        return RetryConfig()
    checkpoint = Path(policy) if policy is not None else shipped(task, "policy")
    path = checkpoint.with_name(checkpoint.name.removesuffix("policy.safetensors") + "retry.toml")
    if not path.exists():
        return RetryConfig()
    try:
        return from_table(RetryConfig, tomllib.loads(path.read_text()), path.name)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from error


def recommend(checkpoint: Path, preset: str, repeat: int = 1) -> Path | None:
    """Put what measured best for such policies beside a new checkpoint; None where nothing is known of the preset, or
    something lies there already. `repeat`: control steps for which an action is repeated."""
    beside = checkpoint.with_name("retry.toml")
    if preset not in STEP_SIZES or beside.exists():
        return None
    beside.write_text(MEASURED_BEST.format(preset=preset, explore=round(EXPLORE / repeat, 3), lr=STEP_SIZES[preset]))
    return beside


def parse(
    options: type[Options], arguments: Sequence[str], prog: str,
    adjust: Callable[[Options, RetryConfig], RetryConfig] = lambda options, retry: retry,
) -> Options:  # fmt: skip
    """Options with the fields task, policy, settings and retry from the command line; what it does not say of retry
    comes from the chosen settings, as `adjust` has them for this robot."""
    given: Any = tyro.cli(options, args=list(arguments), prog=prog)
    chosen = RetryConfig() if given.settings == "paper" else recommended(given.task, given.policy)
    found = adjust(given, chosen)
    return given if found == RetryConfig() else tyro.cli(
        options, args=list(arguments), prog=prog, default=options(retry=found)  # type: ignore[call-arg]
    )  # fmt: skip
