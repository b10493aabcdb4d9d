"""Two machines, one rig: what this one believes of the arm must be what the other one drives."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

from far_app.errors import ArmTaken, ConfigError
from far_app.station import Station, spoken
from hw.rig import RigConfig

ITS_OWN = ("xarm.address", "xarm.port", "input_device.")
"""Beginnings of what only the machine beside the arm needs to know."""


def agreed(rig: RigConfig, task: str, station: Station) -> RigConfig:
    """The rig with the arm's address as the other machine has it. Raises ConfigError where anything else differs, and
    ArmTaken where another app leads that arm."""
    if station.holder:
        raise ArmTaken(
            f"the arm there is led by {spoken(station.holder)}; end that run first: two would fight over one arm"
        )
    if station.task != task:
        raise ConfigError(
            f"the hw server there is set up for task {station.task}, this run is for {task}; say --task {task} there, "
            f"or --task {station.task} here"
        )
    apart = [d for d in differences(dataclasses.asdict(rig), station.rig) if not d[0].startswith(ITS_OWN)]
    if apart:
        some = "; ".join(f"{name} is {here} here and {there} there" for name, here, there in apart[:3])
        raise ConfigError(
            f"the rig here ({rig.name}) and the one of the hw server ({station.rig.get('name')}) differ in "
            f"{len(apart)} settings: {some}; copy the rig file of the machine that has the arm to this one, or update "
            "the older program"
        )
    its = station.rig["xarm"]
    return dataclasses.replace(rig, xarm=dataclasses.replace(rig.xarm, address=its["address"], port=its["port"]))


def differences(here: Mapping[str, Any], there: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Name, value here and value there of every setting that differs."""
    for key in sorted({*here, *there}):
        mine, its = here.get(key), there.get(key)
        if isinstance(mine, Mapping) and isinstance(its, Mapping):
            yield from differences(mine, its, f"{path}{key}.")
        elif mine != its:
            yield f"{path}{key}", mine, its
