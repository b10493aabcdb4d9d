"""`far improve`: collect with retries, learn from what succeeded and what failed, again and again.

A folder for each epoch: attempts.hdf5, critic.safetensors, policy.safetensors; log.jsonl has a line for each that is
done. The same command goes on at any point where it was interrupted. With --from it learns once, from sessions that
were recorded, and says how the policy did before and after.
"""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from tqdm import tqdm

from far_app.cli.assemble import assemble, checkpoints
from far_app.cli.evaluate import run_plan
from far_app.cli.lockstep_twin import LANES, lockstep_twins, origin, trials
from far_app.cli.settings import Settings, parse
from far_app.config import RetryConfig, TaskConfig
from far_app.errors import ConfigError
from far_app.evaluation import REPORT_SCENES, Arm, EvaluationPlan, differences, identity, read_results
from far_app.improvement import Collector, Epoch, Improvement, Noisy, before_and_after, read_log, table
from far_app.tasks import task as find_task
from hw.rig import load_rig

if TYPE_CHECKING:
    from far_app.learning.dataset import Episode

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ImproveOptions:
    """Improve a policy by its own trials; the base checkpoint is never written to."""

    task: str = "lift"
    rig: str = "twin"
    collector: Collector = "far"
    """How episodes are collected: one attempt, naive retry, or failure-aware retry."""
    policy: Path | None = None
    """The shipped quickstart model by default."""
    critic: Path | None = None
    """The one beside the policy by default."""
    data: Path | None = None
    """Demonstrations, D_exp; datasets/TASK.hdf5 by default."""
    demonstrations: int | None = None
    """Use the first so many of them: those the policy was trained on."""
    sessions: Annotated[tuple[Path, ...], tyro.conf.arg(name="from")] = ()
    """Learn once from these recorded sessions, instead of collecting."""
    out: Path | None = None
    """runs/improve-TASK-COLLECTOR-SEED by default."""
    workers: int = 1
    """For the evaluations, side by side."""
    settings: Settings = "model"
    """Begin from what the checkpoint's makers recommend (the retry.toml beside it), or from the paper's settings."""
    loop: Improvement = field(default_factory=Improvement)
    retry: RetryConfig = field(default_factory=RetryConfig)


def main(arguments: Sequence[str]) -> int:
    options = parse(ImproveOptions, arguments, "far improve")
    task = find_task(options.task, load_rig(options.rig).arm)
    policy, critic = checkpoints(task.name, options.policy, options.critic)
    options = dataclasses.replace(options, loop=options.loop.of_critic(card_of(critic)))
    if options.sessions:
        check_sessions(options, policy)
    folder = options.out or Path("runs") / f"improve-{task.name}-{options.collector}-{options.loop.seed}"
    claim(folder, options, policy, critic)
    run(options, task, folder, policy, critic)
    print(table(read_log(folder / "log.jsonl")))
    if options.sessions:
        before, after = (read_results(folder / f"epoch-{n:02d}" / "evaluation" / "episodes.jsonl") for n in (0, 1))
        print(f"\n{before_and_after(before, after)}")
        print(
            f"the finetuned policy is {folder / 'epoch-01' / 'policy.safetensors'}; the one it began from is untouched"
        )
    return 0


def card_of(critic: Path) -> Mapping[str, Any]:
    """What a critic tells of its training; nothing where it cannot be read, which whoever loads it says better."""
    from safetensors import SafetensorError

    from far_app.learning.critic_file import read_card

    try:
        return read_card(critic)
    except (OSError, SafetensorError):
        return {}


def check_sessions(options: ImproveOptions, policy: Path) -> None:
    """ConfigError, before the first evaluation takes its minutes, where sessions hold nothing to learn from, pictures
    of another size than the policy's, or scenes that the evaluation is about to judge on."""
    from far_app.learning.policy import load_policy
    from far_app.recording.episodes import session_episodes
    from far_app.recording.reader import read_session

    config = load_policy(policy, options.task).config
    judged = range(REPORT_SCENES, REPORT_SCENES + options.loop.evaluation_scenes)
    for path in options.sessions:
        episodes = session_episodes(path, options.task)
        if not episodes:
            raise ConfigError(f"--from {path}: no attempt of it ended, there is nothing to learn from")
        twin = read_session(path).header.info.rig.get("robot") == "twin"
        if twin and (seen := sorted({e.seed for e in episodes} & set(judged))):
            raise ConfigError(
                f"--from {path}: its scene {seen[0]} is one that before and after are judged on ({judged.start} to "
                f"{judged.stop - 1}); leave the session out, or judge on fewer (--loop.evaluation-scenes)"
            )
        for camera in config.cameras:
            images = episodes[0].images.get(camera)
            if images is None or images.shape[1:3] != (config.image_size, config.image_size):
                found = "no pictures" if images is None else f"pictures of {images.shape[2]}×{images.shape[1]}"
                raise ConfigError(
                    f"--from {path}: {found} of camera '{camera}', the policy {policy} sees {config.image_size}×"
                    f"{config.image_size}; give sessions that were recorded with this policy's rig"
                )
    if not (data := options.data or Path("datasets") / f"{options.task}.hdf5").exists():
        raise ConfigError(f"no demonstrations at {data}; give those the policy learnt from with --data (far demo)")


def claim(folder: Path, options: ImproveOptions, policy: Path, critic: Path) -> None:
    """ConfigError when the folder holds a run of other settings; the number of epochs may grow."""
    settings = dataclasses.asdict(options.loop)
    settings.pop("epochs")
    plan = json.loads(json.dumps({
        "task": options.task, "rig": options.rig, "collector": options.collector, "loop": settings,
        "policy": identity(str(policy)), "critic": identity(str(critic)), "demonstrations": options.demonstrations,
        "retry": differences(options.retry, RetryConfig()), "from": [path.name for path in options.sessions],
    }))  # fmt: skip
    note = folder / "plan.json"
    if note.exists() and json.loads(note.read_text()) != plan:
        raise ConfigError(f"{folder} holds an improvement of other settings ({note}); give another --out or delete it")
    folder.mkdir(parents=True, exist_ok=True)
    note.write_text(json.dumps(plan, indent=1))


def run(options: ImproveOptions, task: TaskConfig, folder: Path, policy: Path, critic: Path) -> None:
    """Every epoch that is not done yet."""
    import torch

    torch.set_num_threads(1)
    loop, path = options.loop, folder / "log.jsonl"
    done = read_log(path)
    if path.exists():
        path.write_text("".join(json.dumps(dataclasses.asdict(e)) + "\n" for e in done))  # without a torn line
    if not done:
        done = [Epoch(epoch=0, evaluation=evaluate(options, task, folder / "epoch-00", policy, critic))]
        note(path, done[-1])
    for number in range(done[-1].epoch + 1, (1 if options.sessions else loop.epochs) + 1):
        here, before = folder / f"epoch-{number:02d}", folder / f"epoch-{number - 1:02d}"
        now = (before / "policy.safetensors", before / "critic.safetensors") if number > 1 else (policy, critic)
        if not options.sessions:
            collect(options, task, here / "attempts.hdf5", *now, loop.scenes(number))
        by_epoch = experience(options, task, folder, number, policy)
        better, judge = learn(options, task, here, number, *now, [e for found in by_epoch for e in found])
        judged = options.sessions or loop.evaluated(number)
        evaluation = evaluate(options, task, here, better, judge) if judged else None
        done.append(counted(number, by_epoch, evaluation))
        note(path, done[-1])
        log.info("epoch %d: %s", number, dataclasses.asdict(done[-1]))


def counted(number: int, by_epoch: Sequence[Sequence[Episode]], evaluation: dict[str, int] | None) -> Epoch:
    """A line of the log."""
    everything = [e for found in by_epoch for e in found]
    return Epoch(
        epoch=number, episodes=sum(len({e.seed for e in found}) for found in by_epoch),
        timesteps=sum(len(e) - 1 for e in everything), solved=len({e.seed for e in by_epoch[-1] if e.success}),
        successes=sum(e.success for e in everything), failures=sum(not e.success for e in everything),
        evaluation=evaluation,
    )  # fmt: skip


def note(path: Path, epoch: Epoch) -> None:
    with path.open("a") as file:
        file.write(json.dumps(dataclasses.asdict(epoch)) + "\n")


def collect(options: ImproveOptions, task: TaskConfig, path: Path, policy: Path, critic: Path, scenes: range) -> None:
    """Every attempt of an epoch's episodes into its file; a scene whose episode is there already is left alone."""
    from far_app.learning.dataset import episode_of, scenes_in, seen_and_done, write_episode

    missing = [s for s in scenes if s not in scenes_in(path)]
    if missing:
        attempts = 1 if options.collector == "dp" else options.loop.attempts
        task = dataclasses.replace(task, max_attempts=attempts)
        parts = assemble(options.collector, task, str(policy), critic, "cpu", options.retry, lanes=LANES)
        cameras = parts.method.policy.spec.cameras
        robots = lockstep_twins(options.rig, task, min(LANES, len(missing)), bool(cameras))
        methods = [Noisy(parts.another(), options.loop.noise) for _ in robots]
        env_args = origin(task, robots[0].rig)
        for scene, result in tqdm(trials(missing, robots, methods, task), total=len(missing), unit="episode"):
            for attempt in result.attempts:
                episode = episode_of(*seen_and_done(attempt), attempt.outcome.success, scene)
                write_episode(path, episode, env_args)


def experience(
    options: ImproveOptions, task: TaskConfig, folder: Path, epochs: int, policy: Path
) -> list[list[Episode]]:
    """Every attempt there is to learn from, by epoch; those of recorded sessions count as one."""
    from far_app.learning.dataset import read_episodes
    from far_app.learning.policy import load_policy
    from far_app.recording.episodes import session_episodes

    if options.sessions:
        return [[e for session in options.sessions for e in session_episodes(session, task.name)]]
    cameras = load_policy(policy, task.name).config.cameras
    files = [folder / f"epoch-{n:02d}" / "attempts.hdf5" for n in range(1, epochs + 1)]
    return [read_episodes(file, cameras) for file in files]


def learn(
    options: ImproveOptions,
    task: TaskConfig,
    folder: Path,
    number: int,
    policy: Path,
    critic: Path,
    collected: Sequence[Episode],
) -> tuple[Path, Path]:
    """An epoch's models, from everything collected so far."""
    from far_app.learning.dataset import read_episodes
    from far_app.learning.improve import Experience, finetuning
    from far_app.learning.improve import learn as learn_from
    from far_app.learning.policy import load_policy, trained_framings
    from far_app.learning.train_critic import CriticTraining

    config, loop = load_policy(policy, task.name).config, options.loop
    data = options.data or Path("datasets") / f"{task.name}.hdf5"
    known = Experience(
        demonstrations=read_episodes(
            data, config.cameras, options.demonstrations, config.image_size, trained_framings(policy)
        ),
        succeeded=[e for e in collected if e.success], failed=[e for e in collected if not e.success],
    )  # fmt: skip
    seed = loop.seed * 1_000 + number
    assert loop.reward is not None and loop.backup is not None, "of_critic has filled them"
    return learn_from(
        policy, critic, known,
        CriticTraining(iterations=loop.critic_iterations, reward=loop.reward, backup=loop.backup, seed=seed),
        finetuning(config.preset, loop.policy_iterations, seed), folder,
    )  # fmt: skip


def evaluate(options: ImproveOptions, task: TaskConfig, folder: Path, policy: Path, critic: Path) -> dict[str, int]:
    """The policy alone on the reporting scenes."""
    plan = EvaluationPlan(
        task=task.name, rig=options.rig, policy=str(policy), critic=str(critic), arms=(Arm(name="dp", method="dp"),),
        first_scene=REPORT_SCENES, scenes=options.loop.evaluation_scenes, max_attempts=1,
    )  # fmt: skip
    results = folder / "evaluation"
    run_plan(results, plan, options.workers)
    records = read_results(results / "episodes.jsonl")
    return {"scenes": len(records), "solved": sum(r["success"] for r in records)}
