"""Compare ways to retry from the same scenes, in lockstep: one JSONL line an episode, resumable, many at once.

Diffusion noise is keyed by (scene, attempt, tick), scenes come from seeds and homing is the same, so attempt 1 is
identical for every method: a scene solved at the first attempt is solved for all, and is run once.
"""

from __future__ import annotations

import dataclasses
import gzip
import hashlib
import json
import tomllib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from far_app.config import RetryConfig, from_table
from far_app.errors import ConfigError
from far_app.types import Trial
from far_app.workers import Begin, Job, Work, Workers, local_workers

DEV_SCENES = 20_000
"""Scene seeds for choices (settings, variants)."""
REPORT_SCENES = 30_000
"""Scene seeds for reported results; never used for a choice."""


@dataclass(frozen=True, kw_only=True)
class Arm:
    """One column of the comparison."""

    name: str
    method: str
    retry: RetryConfig = field(default_factory=RetryConfig)


@dataclass(frozen=True, kw_only=True)
class EvaluationPlan:
    """What to run; written beside the results, so that results of another plan are never mixed in."""

    task: str
    rig: str
    policy: str
    critic: str
    arms: tuple[Arm, ...]
    first_scene: int
    scenes: int
    max_attempts: int

    def fingerprint(self) -> dict[str, Any]:
        """Everything but the number of scenes, which may grow; checkpoints by name and content, not by place; of the
        settings, those that differ from the paper's."""
        record = {
            "task": self.task, "rig": self.rig, "policy": identity(self.policy), "critic": identity(self.critic),
            "first_scene": self.first_scene, "max_attempts": self.max_attempts,
            "arms": [
                {"name": a.name, "method": a.method, "retry": differences(a.retry, RetryConfig())} for a in self.arms
            ],
        }  # fmt: skip
        return json.loads(json.dumps(record))


def differences(settings: Any, usual: Any) -> dict[str, Any]:
    """The fields in which one dataclass differs from another of its kind, nested as they are."""
    found = {}
    for field_ in dataclasses.fields(settings):
        here, there = getattr(settings, field_.name), getattr(usual, field_.name)
        if dataclasses.is_dataclass(here):
            if inner := differences(here, there):
                found[field_.name] = inner
        elif repr(here) != repr(there):  # NaN is NaN here
            found[field_.name] = here
    return found


def identity(path: str) -> str:
    """A checkpoint's name and the beginning of its checksum; the words themselves where there is no such file."""
    file = Path(path)
    return f"{file.name} sha256:{hashlib.sha256(file.read_bytes()).hexdigest()[:16]}" if file.is_file() else path


def read_arms_file(path: Path) -> tuple[Arm, ...]:
    """The columns of a comparison from a TOML file of [[arm]] tables."""
    if not path.exists():
        raise ConfigError(f"no file of arms at {path}; give one, or --methods")
    try:
        return read_arms(tomllib.loads(path.read_text()), path.name)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from error


def read_arms(table: Mapping[str, Any], source: str) -> tuple[Arm, ...]:
    """The columns of a comparison, each with a name, a method and what differs from its defaults:

    [[arm]]
    name = "far, smaller steps"
    method = "far"
    retry.fcpa = { lr = 2e-6, guard = "scale" }
    """
    entries = table.get("arm")
    if set(table) != {"arm"} or not isinstance(entries, list) or not entries:
        raise ConfigError(f"{source} has the tables {', '.join(table) or '(none)'}; it must list [[arm]] tables alone")
    arms = []
    for number, entry in enumerate(entries, 1):
        where = f"{source}: arm {number}"
        missing = {"name", "method"} - set(entry)
        if missing:
            raise ConfigError(f"{where} has no {', '.join(sorted(missing))}")
        arms.append(from_table(Arm, entry, where))
    if len({a.name for a in arms}) < len(arms):
        raise ConfigError(f"{source} names an arm twice; every arm needs a name of its own")
    return tuple(arms)


def episode_record(arm: str, scene: int, result: Trial) -> dict[str, Any]:
    """One line of the results."""
    return {
        "arm": arm, "scene": scene, "success": result.success, "attempts": len(result.attempts),
        "ticks": [len(a.steps) for a in result.attempts],
        "adaptations": [
            {
                "status": a.status, "pairs": a.pairs, "empty": a.empty_states, "flagged": len(a.flagged),
                "winner": [s.winner_error for s in a.history[:: max(1, len(a.history) - 1)]],
                "loser": [s.loser_error for s in a.history[:: max(1, len(a.history) - 1)]],
                "seconds": sum(a.seconds.values()),
            }
            for a in result.adaptations
        ],
    } | ({"rescues": result.rescues} if result.rescues else {})  # fmt: skip


Episode = tuple[str, int]
"""An arm and a scene."""


def run_scenes(
    jobs: Iterable[Job], arms: Sequence[str],
    run: Callable[[Callable[[], Episode | None]], Iterator[tuple[Episode, Trial]]],
) -> Iterator[dict[str, Any]]:  # fmt: skip
    """The missing records of scenes, each as it is there; `run` runs the episodes it is handed side by side. A scene's
    first arm goes first: a success at the first attempt is every arm's, and is run once. Scenes are taken from `jobs`
    one by one, as room is."""
    waiting = iter(jobs)
    known: dict[int, dict[str, dict[str, Any]]] = {}
    ready: deque[Episode] = deque()
    told: deque[dict[str, Any]] = deque()

    def follow(scene: int) -> None:
        """What is next for a scene of which something is known: nothing more to run, or all other arms."""
        missing = [a for a in arms if a not in known[scene]]
        shared = next((r for r in known[scene].values() if r["success"] and r["attempts"] == 1), None)
        if shared is None:
            ready.extend((arm, scene) for arm in missing)
        else:
            told.extend(shared | {"arm": arm, "shared": True} for arm in missing)
        del known[scene]

    def take() -> Episode | None:
        while not ready and (job := next(waiting, None)) is not None:
            scene, done = job
            known[scene] = dict(done)
            if not done:
                return arms[0], scene
            follow(scene)
        return ready.popleft() if ready else None

    for (arm, scene), result in run(take):
        record = episode_record(arm, scene, result)
        yield record
        if scene in known:
            known[scene][arm] = record
            follow(scene)
        while told:
            yield told.popleft()
    yield from told


def read_results(path: Path) -> list[dict[str, Any]]:
    """Whole lines of a results file, or of its gzip where only that is there; a torn last line (a killed run) is left
    out."""
    packed = packed_results(path)
    if path.exists():
        text = path.read_text()
    elif packed.exists():
        text = gzip.decompress(packed.read_bytes()).decode()
    else:
        return []
    records = []
    for line in text.splitlines():
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return records


def packed_results(path: Path) -> Path:
    """Results as they are committed: `gzip -9n episodes.jsonl`."""
    return path.with_name(path.name + ".gz")


def prepare(folder: Path, plan: EvaluationPlan) -> dict[int, dict[str, dict[str, Any]]]:
    """What a folder already holds, by scene and arm; ConfigError when it is another plan's. A plan may have grown by
    arms: what there is of the others stays."""
    folder.mkdir(parents=True, exist_ok=True)
    note, here = folder / "plan.json", plan.fingerprint()
    if note.exists():
        there = json.loads(note.read_text())
        lost = [a for a in there.pop("arms", ()) if a not in here["arms"]]
        if lost or there != {k: v for k, v in here.items() if k != "arms"}:
            raise ConfigError(f"{folder} holds results of another plan ({note}); give another --out or delete it")
    note.write_text(json.dumps(here, indent=1))
    found: dict[int, dict[str, dict[str, Any]]] = {}
    for record in read_results(folder / "episodes.jsonl"):
        found.setdefault(record["scene"], {})[record["arm"]] = record
    return found


def evaluate(
    folder: Path, plan: EvaluationPlan, workers: int, progress: Callable[[dict[str, Any]], None], begin: Begin,
    work: Work, run: Workers = local_workers,
) -> None:  # fmt: skip
    """Run what is missing; every finished episode is on disk before the next is counted. `begin` sets a worker process
    up, `work` runs a stream of scenes in it; both are importable functions (far_app/cli/evaluate.py)."""
    found = prepare(folder, plan)
    names = {a.name for a in plan.arms}
    scenes = range(plan.first_scene, plan.first_scene + plan.scenes)
    jobs = [(s, found.get(s, {})) for s in scenes if names - set(found.get(s, {}))]
    results = folder / "episodes.jsonl"
    if not results.exists() and (packed := packed_results(results)).exists():
        results.write_bytes(gzip.decompress(packed.read_bytes()))  # goes on where the committed results ended
    if results.exists() and not (whole := results.read_bytes()).endswith(b"\n"):
        results.write_bytes(whole[: whole.rfind(b"\n") + 1])  # a killed run's torn line; its episode is run again
    if not jobs:
        return
    with results.open("a") as file:
        for record in run(plan, jobs, workers, begin, work):
            file.write(json.dumps(record) + "\n")
            file.flush()
            progress(record)
