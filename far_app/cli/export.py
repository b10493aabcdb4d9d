"""`far export SESSION... --to lerobot|robomimic|rrd`: recorded attempts in other programs' formats."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from far_app.config import TaskConfig, from_table
from far_app.errors import ConfigError
from far_app.exchange.rrd import write_rrds
from far_app.exchange.select import Only, Selection, chosen, rollouts
from far_app.recording.inspect import find_session
from far_app.recording.reader import read_session
from far_app.recording.schema import SessionInfo
from far_app.tasks import task
from hw.rig import RigConfig
from hw.setup import setup_of


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Recorded attempts as a dataset; docs/data.md says what each format holds."""

    sessions: tyro.conf.Positional[tuple[Path, ...]]
    """Recorded sessions."""
    to: Literal["lerobot", "robomimic", "rrd"]
    """LeRobotDataset v3 (a folder), robomimic HDF5 (a file) or rerun (a folder with a file an attempt)."""
    out: Path
    only: Only = "all"
    """successes; recoveries: successes after a failed attempt, or with a person's help; human: where a person moved
    the arm."""
    segment: Literal["attempt", "recovery"] = "attempt"
    """recovery: from the failure's state on."""
    instruction: str = ""
    """Words for the task, for policies that are told what to do; the task's name by default."""
    overwrite: bool = False
    """Replace what is at --out."""


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(ExportOptions, args=list(arguments), prog="far export")
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    if not options.sessions:
        raise ConfigError("no session given; far export recordings/sample --to lerobot --out DATASET, for example")
    sessions = list(dict.fromkeys(find_session(path) for path in options.sessions))
    infos = [read_session(path).header.info for path in sessions]
    selection = Selection(only=options.only, segment=options.segment)
    left_out: list[str] = []

    def say(line: str) -> None:
        left_out.append(line)
        print(f"far: {line}", file=sys.stderr)

    if options.to == "lerobot":
        from far_app.exchange.lerobot import write_lerobot

        check_alike(sessions, infos)
        count = write_lerobot(
            options.out, rollouts(sessions, selection, say), infos[0].rate, env_args(infos[0]),
            lambda name: options.instruction or name, options.overwrite,
        )  # fmt: skip
    elif options.to == "robomimic":
        from far_app.exchange.robomimic import write_robomimic

        check_alike(sessions, infos)
        count = write_robomimic(options.out, rollouts(sessions, selection, say), env_args(infos[0]), options.overwrite)
    else:
        from ui.rerun_views import attempt_to_rrd

        count = write_rrds(options.out, chosen(sessions, selection, say), attempt_to_rrd, options.overwrite)
    print(f"{options.out}: {count} episodes{f', {len(left_out)} remarks above' if left_out else ''}")
    return 0


def check_alike(sessions: Sequence[Path], infos: Sequence[SessionInfo]) -> None:
    """ConfigError when two sessions are of different tasks, or run at different rates or on different robots."""

    def words(info: SessionInfo) -> str:
        return f"'{info.task}' on a {robot_name(info)} at {info.rate:g} Hz"

    for path, info in zip(sessions, infos, strict=True):
        if words(info) != words(infos[0]):
            raise ConfigError(f"{path} is of {words(info)}, {sessions[0]} of {words(infos[0])}; export them apart")


def env_args(info: SessionInfo) -> dict[str, Any]:
    """Where the episodes come from, as robomimic has it (and `far demo` writes it)."""
    environment = info.config.get("task", {}).get("environment") or task(info.task).environment
    kwargs = {"robots": robot_name(info), "rig": dict(info.rig)}
    return {"env_name": environment, "type": 1, "env_kwargs": kwargs, "setup": setup(info)}


def setup(info: SessionInfo) -> dict[str, Any] | None:
    """What the preflight of a policy that learns from the session compares; None where an older recording does not say
    enough."""
    try:
        rig = from_table(RigConfig, info.rig, "rig")
        return setup_of(rig, from_table(TaskConfig, info.config["task"], "task")).table()
    except (ConfigError, KeyError, TypeError, AttributeError):
        return None


def robot_name(info: SessionInfo) -> str:
    """The arm's name; recordings from before several arms were known are of the xArm7."""
    return str(info.rig.get("arm", "xarm7"))
