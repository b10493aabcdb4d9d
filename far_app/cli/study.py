"""`far study`: make the models a study asks for, evaluate every arm on each, and say what came out.

Everything goes on where it was interrupted: demonstrations, training, and every single episode.
"""

from __future__ import annotations

import logging
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import tyro

from far_app.cli.assemble import check_methods
from far_app.cli.evaluate import run_plan
from far_app.cli.report import write_report
from far_app.errors import FarError
from far_app.study import Study, demonstrating, model_folder, read_study, training

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class StudyOptions:
    """Models, episodes and tables of a study; a second start goes on where the first one stopped."""

    study: tyro.conf.Positional[Path]
    """The study, a TOML file."""
    out: Path | None = None
    """Folder of the models and results; runs/ and the study's name by default."""
    workers: int = 2


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(StudyOptions, args=list(arguments), prog="far study")
    study = read_study(options.study)
    check_methods([arm.method for arm in study.arms])
    folder = options.out or Path("runs") / options.study.stem
    make_models(study, folder, options.workers)
    for task, seed in study.models:
        print(f"{task.name}, training seed {seed}", flush=True)
        run_plan(folder / f"{task.name}-{seed}", study.plan(folder, task, seed), options.workers)
    print(write_report([folder], folder))
    return 0


def make_models(study: Study, folder: Path, workers: int) -> None:
    """Every model that is not there yet, side by side; one thread each."""
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(lambda task: command(demonstrating(study, folder, task)), study.tasks))
        missing = [
            (task, seed)
            for task, seed in study.models
            if not (model_folder(folder, task, seed) / "critic.safetensors").exists()
        ]
        list(pool.map(lambda job: [command(words) for words in training(study, folder, *job)], missing))


def command(words: Sequence[str]) -> None:
    """One of our own commands in a process of its own. Raises FarError with its last words."""
    log.info("far %s", " ".join(words))
    done = subprocess.run(
        [sys.executable, "-c", "import sys; from far_app.cli import main; sys.exit(main())", *words],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False,
    )  # fmt: skip
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise FarError(f"`far {' '.join(words)}` failed: {last}")
