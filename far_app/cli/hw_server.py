"""`far hw-server`: the process that owns the arm, on the robot PC, for a `far run --hw` on another machine."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from far_app.cli.options import RunOptions
from far_app.endpoints import Endpoints
from far_app.keys import server_keys


@dataclass(frozen=True, kw_only=True)
class ServerOptions:
    """Own the arm and its cameras here; the app runs on another machine. Holds the arm whenever that falls silent."""

    bind: str
    """tcp://ADDRESS:PORT of this machine; six ports from that one on are used."""
    keys: Path | None = None
    """Folder of the CURVE keys (see far keys); any address but loopback needs them."""
    task: str = "lift"
    """The task of the far run to come: its release, its way home, its rate."""
    robot: Literal["twin", "xarm"] | None = None
    """twin simulates, xarm is a real xArm7; the rig file's own when it is not given."""
    rig: str | None = None
    """Name below hw/rigs, or the path of a rig's TOML file; the robot's own by default (twin, xarm7)."""
    host: str = ""
    """ADDRESS[:PORT] of a real arm's controller, over the rig file's."""


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(ServerOptions, args=list(arguments), prog="far hw-server")
    run = RunOptions(task=options.task, robot=options.robot, rig=options.rig, host=options.host)
    run.load_rig()
    Endpoints.at(options.bind, server_keys(options.keys) if options.keys is not None else None)
    from hw import server  # sets up GL: not for those that only ask for --help

    words = ["--bind", options.bind, "--rig", run.rig_file, "--task", options.task]
    words += ["--keys", str(options.keys)] * (options.keys is not None) + ["--address", options.host] * bool(
        options.host
    )
    code = server.main(words)
    logging.shutdown()
    os._exit(code)  # daemon threads inside a GL driver must not delay the end
