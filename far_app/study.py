"""A study, as data: tasks × training seeds × arms. Which commands make its models, and which plans evaluate them.

A TOML file; see docs/results/panda-state.toml. Pure: far_app/cli/study.py runs what this says.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from far_app.config import from_table
from far_app.errors import ConfigError
from far_app.evaluation import REPORT_SCENES, Arm, EvaluationPlan, read_arms
from far_app.tasks import TASKS


@dataclass(frozen=True, kw_only=True)
class StudyTask:
    """How one task's models are made."""

    name: str
    demonstrations: int
    """Chosen so that the policy alone succeeds between 30 and 75 % of the time."""
    iterations: int
    """Of the policy's training."""
    attempts: int = 100
    """The policy's own exploring attempts, for the critic."""
    explore: float = 0.3
    backup: int = 8
    critic_iterations: int = 10_000

    def __post_init__(self) -> None:
        if self.name not in TASKS:
            raise ConfigError(f"unknown task '{self.name}'; choose one of: {', '.join(sorted(TASKS))}")


@dataclass(frozen=True, kw_only=True)
class Study:
    rig: str
    preset: str
    seeds: tuple[int, ...]
    """Training seeds."""
    scenes: int
    """Reporting scenes for each training seed; no two seeds share one."""
    max_attempts: int
    tasks: tuple[StudyTask, ...]
    arms: tuple[Arm, ...]

    @property
    def models(self) -> list[tuple[StudyTask, int]]:
        return [(task, seed) for task in self.tasks for seed in self.seeds]

    def plan(self, folder: Path, task: StudyTask, seed: int) -> EvaluationPlan:
        model = model_folder(folder, task, seed)
        return EvaluationPlan(
            task=task.name, rig=self.rig, policy=str(model / "policy.safetensors"),
            critic=str(model / "critic.safetensors"), arms=self.arms,
            first_scene=REPORT_SCENES + seed * self.scenes, scenes=self.scenes, max_attempts=self.max_attempts,
        )  # fmt: skip


def read_study(path: Path) -> Study:
    """Raises ConfigError that names the place."""
    if not path.exists():
        raise ConfigError(f"no study at {path}; see docs/results/panda-state.toml")
    try:
        table = tomllib.loads(path.read_text())
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from error
    fields = {f.name for f in dataclasses.fields(Study)} - {"tasks", "arms"}
    if missing := fields - set(table):
        raise ConfigError(f"{path.name} does not say {', '.join(sorted(missing))}")
    tasks = tuple(from_table(StudyTask, t, f"{path.name}: task {i}") for i, t in enumerate(table.pop("task", ()), 1))
    arms = read_arms({"arm": table.pop("arm", [])}, path.name)
    if not tasks:
        raise ConfigError(f"{path.name} lists no [[task]]")
    if unknown := set(table) - fields:
        raise ConfigError(f"{path.name}: unknown setting {', '.join(sorted(unknown))}; known: {', '.join(fields)}")
    return Study(
        rig=table["rig"], preset=table["preset"], seeds=tuple(table["seeds"]), scenes=table["scenes"],
        max_attempts=table["max_attempts"], tasks=tasks, arms=arms,
    )  # fmt: skip


def model_folder(folder: Path, task: StudyTask, seed: int) -> Path:
    return folder / "models" / f"{task.name}-{seed}"


def demonstrations_file(folder: Path, task: StudyTask) -> Path:
    return folder / "models" / f"{task.name}.hdf5"


def demonstrating(study: Study, folder: Path, task: StudyTask) -> list[str]:
    """The command that makes a task's demonstrations, shared by its seeds."""
    return [
        "demo", "--task", task.name, "--rig", study.rig, "--n", str(task.demonstrations),
        "--out", str(demonstrations_file(folder, task)), *images(study),
    ]  # fmt: skip


def training(study: Study, folder: Path, task: StudyTask, seed: int) -> list[list[str]]:
    """The commands that make one model, in order; each goes on where it was interrupted."""
    model, data = model_folder(folder, task, seed), str(demonstrations_file(folder, task))
    policy, attempts = str(model / "policy.safetensors"), str(model / "attempts.hdf5")
    return [
        ["train", "policy", "--task", task.name, "--preset", study.preset, "--data", data, "--out", str(model),
         "--demonstrations", str(task.demonstrations), "--iterations", str(task.iterations), "--seed", str(seed),
         "--threads", "1"],
        ["demo", "--task", task.name, "--rig", study.rig, "--policy", policy, "--explore", str(task.explore),
         "--n", str(task.attempts), "--seed", str(50_000 + 1_000 * seed), "--out", attempts, *images(study)],
        ["train", "critic", "--task", task.name, "--policy", policy, "--data", data, "--attempts", attempts,
         "--demonstrations", str(task.demonstrations), "--backup", str(task.backup),
         "--iterations", str(task.critic_iterations), "--seed", str(seed), "--threads", "1"],
    ]  # fmt: skip


def images(study: Study) -> Sequence[str]:
    return ("--no-images",) if study.preset == "state" else ()
