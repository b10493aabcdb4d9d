"""A plan's TOML file, checked whole before anything starts: file, key, value and choices in every refusal."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from far_app.config import RetryConfig, from_table
from far_app.errors import ConfigError
from far_app.tasks import TASKS
from far_app.trial_plan.plan import (
    MOST_ATTEMPTS,
    MOST_REPETITIONS,
    MOST_TRIALS,
    SEEDS,
    PlannedMethod,
    Scene,
    TrialPlan,
    seeded,
    valid_name,
)

_TOP = (
    "name", "task", "seed", "repetitions", "blind", "max_attempts", "precision", "match", "seeds", "scene", "method",
)  # fmt: skip
_METHOD = ("name", "method", "policy", "critic", "settings", "retry")
_SCENE = ("name", "image", "camera", "recording", "trial")
_KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "text", list: "a list", dict: "a table"}


def read_plan(file: Path, *, robot: str, cameras: Sequence[str], methods: Sequence[str]) -> TrialPlan:
    """The plan for this robot ("twin" or "xarm"), its cameras and the known methods. Raises ConfigError."""
    try:
        table = tomllib.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"no plan at {file}; docs/trials.md has one to begin from") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{file} is no TOML file: {error}") from error
    top = _Table(table, str(file), _TOP)
    plan = TrialPlan(
        file=file, name=_name(top, file.stem), task=top.choice("task", TASKS), robot=robot,
        methods=tuple(_method(t, methods) for t in top.tables("method", _METHOD)),
        scenes=_scenes(top, robot, cameras), repetitions=top.whole("repetitions", 1, 1, MOST_REPETITIONS),
        seed=top.whole("seed", 0, 0, SEEDS - 1), blind=top.value("blind", bool, False),
        max_attempts=top.whole("max_attempts", 1, 1, MOST_ATTEMPTS) if "max_attempts" in table else None,
        precision=top.number("precision", 10.0, 0.1, 100.0), match=top.number("match", 0.8, 0.0, 1.0),
    )  # fmt: skip
    if len(plan.methods) < 2:
        raise ConfigError(f"{file}: {len(plan.methods)} [[method]] tables; a comparison needs at least 2")
    top.distinct("method", "name", [m.name for m in plan.methods])
    top.distinct("scene", "name", [s.name for s in plan.scenes])
    if plan.trials > MOST_TRIALS:
        raise top.wrong(
            "repetitions", plan.repetitions,
            f"such that methods × scenes × repetitions is at most {MOST_TRIALS} (it is {plan.trials})",
        )  # fmt: skip
    return plan


def _name(top: _Table, usual: str) -> str:
    name = top.value("name", str, usual)
    if not valid_name(name):
        raise top.wrong("name", name, "1 to 40 letters, digits, spaces and . _ + -, beginning with a letter or digit")
    return name


def _method(table: _Table, known: Sequence[str]) -> PlannedMethod:
    method = table.choice("method", known)
    retry = table.value("retry", dict, {})
    try:
        from_table(RetryConfig, retry, "")
    except ConfigError as error:
        raise ConfigError(f"{table.at('retry')}{'' if str(error).startswith(('.', ':')) else ': '}{error}") from error
    return PlannedMethod(
        name=_name(table, method), method=method, policy=table.policy(), critic=table.file("critic"),
        settings=table.choice("settings", ("model", "paper"), "model"), retry=retry,
    )  # fmt: skip


def _scenes(top: _Table, robot: str, cameras: Sequence[str]) -> tuple[Scene, ...]:
    if robot == "twin":
        if "scene" in top.table:
            raise top.wrong("scene", "given", "left out on the twin: its scenes are seeds = [...]")
        return seeded(_seeds(top))
    if "seeds" in top.table:
        raise top.wrong("seeds", top.table["seeds"], "left out on a real arm: its scenes are [[scene]] tables")
    tables = top.tables("scene", _SCENE)
    if not tables:
        raise ConfigError(f"{top.where}: no [[scene]] table; name at least one scene of the real arm")
    return tuple(_real_scene(table, number, cameras) for number, table in enumerate(tables))


def _seeds(top: _Table) -> list[int]:
    given = top.table.get("seeds")
    if isinstance(given, dict):
        span = _Table(given, top.at("seeds"), ("first", "count"), joint=".")
        first = span.whole("first", 0, 0, SEEDS - 1)
        return list(range(first, first + span.whole("count", 1, 1, min(MOST_TRIALS, SEEDS - first))))
    if not isinstance(given, list) or not given:
        raise top.wrong("seeds", given, "a list of scene seeds, or { first = N, count = N }")
    for number, seed in enumerate(given, 1):
        if not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= seed < SEEDS:
            raise ConfigError(f"{top.where}: seeds[{number}] is {seed!r}, must be a whole number from 0 to {SEEDS - 1}")
    return given


def _real_scene(table: _Table, number: int, cameras: Sequence[str]) -> Scene:
    name, images, recording, trial = _name(table, f"scene {number + 1}"), {}, None, 0
    if "image" in table.table and "recording" in table.table:
        raise table.wrong("recording", table.table["recording"], "left out where image is given")
    if (image := table.file("image")) is not None:
        images = {table.choice("camera", cameras, cameras[0] if cameras else None): image}
    elif "camera" in table.table:
        raise table.wrong("camera", table.table["camera"], "left out where there is no image")
    if (recording := table.file("recording", folder=True)) is not None:
        trial = table.whole("trial", 1, 1, 9999)
        if not (recording / f"trial_{trial:04d}" / "attempt_1.mcap").exists():
            raise table.wrong("trial", trial, f"a trial that {recording} holds an attempt of")
    elif "trial" in table.table:
        raise table.wrong("trial", table.table["trial"], "left out where there is no recording")
    return Scene(name=name, seed=number, images=images, recording=recording, trial=trial)


class _Table:
    """A TOML table that says in every refusal where it is."""

    def __init__(self, table: Mapping[str, Any], where: str, known: Sequence[str], joint: str = ": ") -> None:
        self.table, self.where, self.joint = table, where, joint
        if unknown := sorted(set(table) - set(known)):
            raise ConfigError(f"{self.at(unknown[0])} is not known here; known: {', '.join(known)}")

    def at(self, key: str) -> str:
        return f"{self.where}{self.joint}{key}"

    def wrong(self, key: str, value: object, must: str) -> ConfigError:
        return ConfigError(f"{self.at(key)} is {value!r}, must be {must}")

    def value(self, key: str, kind: type, usual: Any) -> Any:
        value = self.table.get(key, usual)
        fits = isinstance(value, int | float if kind is float else kind)
        if not fits or (isinstance(value, bool) and kind is not bool):
            raise self.wrong(key, value, _KINDS[kind])
        return value

    def whole(self, key: str, usual: int, least: int, most: int) -> int:
        value = self.value(key, int, usual)
        if not least <= value <= most:
            raise self.wrong(key, value, f"from {least} to {most}")
        return value

    def number(self, key: str, usual: float, least: float, most: float) -> float:
        value = float(self.value(key, float, usual))
        if not least <= value <= most:
            raise self.wrong(key, value, f"from {least:g} to {most:g}")
        return value

    def choice(self, key: str, choices: Sequence[str] | Mapping[str, object], usual: str | None = None) -> str:
        value = self.table.get(key, usual)
        if value not in choices:
            raise self.wrong(key, value, f"one of: {', '.join(choices) or 'none (the rig has no cameras)'}")
        return value

    def file(self, key: str, *, folder: bool = False) -> Path | None:
        """A file that exists, relative to the plan's own folder."""
        if key not in self.table:
            return None
        path = self.place / self.value(key, str, "")
        if not (path.is_dir() if folder else path.is_file()):
            raise self.wrong(key, self.table[key], f"a {'folder' if folder else 'file'} that exists (none at {path})")
        return path

    def policy(self) -> str | None:
        """A checkpoint, or the name of a policy without one (untrained:, test:)."""
        given = self.table.get("policy")
        if isinstance(given, str) and given.startswith(("untrained:", "test:")):
            return given
        path = self.file("policy")
        return None if path is None else str(path)

    @property
    def place(self) -> Path:
        return Path(self.where.partition(": ")[0]).parent

    def tables(self, key: str, known: Sequence[str]) -> list[_Table]:
        entries = self.value(key, list, [])
        for entry in entries:
            if not isinstance(entry, dict):
                raise self.wrong(key, entry, f"[[{key}]] tables")
        return [_Table(e, f"{self.where}: {key}[{n}]", known, joint=".") for n, e in enumerate(entries, 1)]

    def distinct(self, key: str, field: str, values: Sequence[object]) -> None:
        for number, value in enumerate(values, 1):
            if value in values[: number - 1]:
                where = f"{self.where}: seeds" if key not in self.table else f"{self.at(key)}[{number}].{field}"
                raise ConfigError(f"{where} says {value!r} twice; each must be different")
