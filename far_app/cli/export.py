"""`far export SESSION... --to lerobot|robomimic|rrd`: recorded attempts in other programs' formats."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from far_app.errors import ConfigError
from far_app.exchange.select import Only, Selection, rollouts
from far_app.recording.inspect import find_session
from far_app.recording.reader import read_session
from far_app.recording.schema import SessionInfo


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
            options.out, rollouts(sessions, selection, say), infos[0].rate, robot_name(infos[0]),
            lambda task: options.instruction or task, options.overwrite,
        )  # fmt: skip
    else:
        raise ConfigError(f"--to {options.to} is not there yet")
    print(f"{options.out}: {count} episodes{f', {len(left_out)} remarks above' if left_out else ''}")
    return 0


def check_alike(sessions: Sequence[Path], infos: Sequence[SessionInfo]) -> None:
    """ConfigError when two sessions run at different rates or on different robots."""
    for path, info in zip(sessions, infos, strict=True):
        here, first = (info.rate, robot_name(info)), (infos[0].rate, robot_name(infos[0]))
        if here != first:
            raise ConfigError(
                f"{path} is of a {here[1]} at {here[0]:g} Hz, {sessions[0]} of a {first[1]} at {first[0]:g} Hz; "
                "export them apart"
            )


def robot_name(info: SessionInfo) -> str:
    """The arm's name; recordings from before several arms were known are of the xArm7."""
    return str(info.rig.get("arm", "xarm7"))
