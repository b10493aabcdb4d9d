"""`far run`: the whole application. Starts the hw server and the page, loads the policy meanwhile, runs the session."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from far_app.cli.assemble import Parts, assemble, check_observation
from far_app.cli.ports import answers, choose_port
from far_app.cli.processes import Child, Family, run_folder
from far_app.config import RetryConfig, TaskConfig
from far_app.detectors import TwinCheck
from far_app.endpoints import Endpoints
from far_app.errors import ConfigError, FarError, RobotError
from far_app.link import RemoteRobot
from far_app.protocols import PlanRequest
from far_app.recording.schema import SessionInfo
from far_app.recording.writer import SessionWriter
from far_app.session.inbox import IntentInbox
from far_app.session.planners import ThreadedPlanner, plan_one
from far_app.session.publisher import TelemetryPublisher
from far_app.session.realtime import prepare_process
from far_app.session.recorder import Recorder
from far_app.session.session import Session, SessionSettings, TrialResult
from far_app.session.statistics import LoopStatistics
from far_app.session_states import Intent
from far_app.tasks import task as find_task
from hw.rig import RigConfig, load_rig

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Supervised trials: the policy tries, the app judges, learns from failure and retries; you watch."""

    trials: int = 0
    """Trials to run; 0 goes on until you quit."""
    seed: int = 0
    """Scene seed of the first trial; the next trial has the next."""
    headless: bool = False
    """No page; a fault ends the run with an error."""
    summary_json: Path | None = None
    """Write the summary here at the end."""
    method: str = "far"
    """How to retry: dp, nr, perturb, fcpa, far."""
    task: str = "lift"
    rig: str = "twin"
    """Name below hw/rigs, or the path of a rig's TOML file."""
    policy: str | None = None
    """Policy checkpoint; the shipped quickstart model by default."""
    critic: Path | None = None
    """Critic checkpoint; the one beside the policy by default."""
    device: str = "cpu"
    """cpu or cuda."""
    max_attempts: int | None = None
    """Attempts a trial; the task's by default."""
    port: int = 8080
    """The page's port; 0 takes a free one."""
    host: str = "127.0.0.1"
    """Address the page binds to."""
    rerun: bool = True
    """Show the session live in a rerun viewer too."""
    scene3d: bool = True
    """Show the arm in 3D on the page."""
    recordings: Path = Path("recordings")
    """Folder of the sessions."""
    torch_threads: int = 1
    """Threads of one torch operation in the loop's process."""
    retry: RetryConfig = field(default_factory=RetryConfig)
    """Settings of the method."""
    verbose: bool = False
    """Log every phase change to the terminal."""

    def __post_init__(self) -> None:
        if self.trials < 0:
            raise ConfigError(f"--trials is {self.trials}, must be at least 0 (0 runs until you quit)")
        if self.seed < 0:
            raise ConfigError(f"--seed is {self.seed}, must be at least 0")
        if self.torch_threads < 1:
            raise ConfigError(f"--torch-threads is {self.torch_threads}, must be at least 1")


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(RunOptions, args=list(arguments), prog="far run")
    logging.basicConfig(
        level=logging.INFO if options.verbose else logging.WARNING,
        format="%(asctime)s %(name)s %(levelname)s %(message)s",
    )
    results, statistics = run(options)
    summary = {"trials": [dataclasses.asdict(r) for r in results], **statistics.summary()}
    if options.summary_json is not None:
        options.summary_json.write_text(json.dumps(summary, indent=2) + "\n")
    good = sum(r.success for r in results)
    print(f"{good} of {len(results)} trials succeeded", flush=True)
    return 0


def run(options: RunOptions) -> tuple[list[TrialResult], LoopStatistics]:
    """Start everything, run the session, end everything."""
    task, rig = find_task(options.task), load_rig(options.rig)
    port = 0 if options.headless else choose_port(options.host, options.port)
    quitting = _Quit()
    with quitting.on_signals(), run_folder() as folder, _family() as family:
        hardware = family.add(start_hardware(folder, options.rig, options.task))
        page = None if options.headless else family.add(start_page(folder, options, port))
        parts = assemble(options.method, task, options.policy, options.critic, options.device, options.retry)
        attempts = options.max_attempts or parts.max_attempts or task.max_attempts
        task = dataclasses.replace(task, max_attempts=attempts)
        with connected(folder, hardware) as robot:
            if page is not None:
                wait_for_page(page, options.host, port)
                print(f"The operator page is at http://{options.host}:{port}", flush=True)
            check_observation(parts.method.policy.spec, robot.observe())
            warm_up(parts, robot)
            return conduct(options, task, rig, parts, robot, folder, family, page, quitting)


def conduct(
    options: RunOptions,
    task: TaskConfig,
    rig: RigConfig,
    parts: Parts,
    robot: RemoteRobot,
    folder: Path,
    family: Family,
    page: Child | None,
    quitting: _Quit,
) -> tuple[list[TrialResult], LoopStatistics]:
    """The session itself, once all processes are ready."""
    endpoints, statistics = Endpoints.in_folder(folder), LoopStatistics()
    writer = SessionWriter(
        options.recordings,
        SessionInfo(
            task=task.name, method=options.method, rig=dataclasses.asdict(rig), policy=parts.policy_name,
            seed=options.seed, cameras=parts.method.policy.spec.cameras, rate=task.rate,
            config={"run": dataclasses.asdict(options), "task": dataclasses.asdict(task)},
        ),
    )  # fmt: skip
    print(f"Recording to {writer.folder}", flush=True)
    inbox = IntentInbox(endpoints.intents)
    quitting.tell(inbox)
    publisher = None if page is None else TelemetryPublisher(endpoints.telemetry, statistics.health)
    prepare_process(options.torch_threads)
    session = Session(
        settings=SessionSettings(
            name=writer.folder.name, trials=options.trials, seed=options.seed, headless=options.headless,
            adaptation_limit=options.retry.adaptation_limit,
        ),
        robot=robot, planner=ThreadedPlanner(), method=parts.method, detector=TwinCheck(task.success_ticks), task=task,
        scale=rig.scale, recorder=Recorder(writer), inbox=inbox, statistics=statistics, publisher=publisher,
    )  # fmt: skip
    with _revived(family, page):
        try:
            session.run()
        finally:
            inbox.close()
            if publisher is not None:
                publisher.close()
    if session.recorder.error is not None:
        raise session.recorder.error
    return session.results, statistics


def start_hardware(folder: Path, rig: str, task: str) -> Child:
    arguments = ["--folder", str(folder), "--rig", rig, "--task", task, "--parent", str(os.getpid())]
    return Child("hardware", "hw.server", arguments, folder)


def start_page(folder: Path, options: RunOptions, port: int) -> Child:
    arguments = ["--run-folder", str(folder), "--host", options.host, "--port", str(port)]
    if not options.scene3d:
        arguments.append("--no-scene3d")
    return Child("page", "ui.server", arguments, folder)


@contextlib.contextmanager
def connected(folder: Path, hardware: Child, limit: float = 180.0) -> Iterator[RemoteRobot]:
    """The robot behind the hw server, once it shows its first observation (a first start compiles for a while)."""
    deadline = time.monotonic() + limit
    robot = None
    while robot is None:
        hardware.check()
        try:
            robot = RemoteRobot(Endpoints.in_folder(folder), connect_timeout=1.0)
        except RobotError as error:
            if time.monotonic() > deadline:
                raise RobotError(f"the hw server showed nothing within {limit:.0f} s of its start: {error}") from error
    try:
        yield robot
    finally:
        robot.close()


def wait_for_page(page: Child, host: str, port: int, limit: float = 60.0) -> None:
    deadline = time.monotonic() + limit
    while not answers(host, port):
        page.check()
        if time.monotonic() > deadline:
            raise FarError(f"the page did not answer at {host}:{port} within {limit:.0f} s; see {page.log_path}")
        time.sleep(0.05)


def warm_up(parts: Parts, robot: RemoteRobot) -> None:
    """A few chunks before the clock matters: the first ones of a network take many times the later ones."""
    policy = parts.method.policy
    history = (robot.observe(),) * policy.spec.n_obs
    for i in range(3):
        plan_one(PlanRequest(history=history, tick=i, noise_key=(0, 0, i), policy=policy))


@contextlib.contextmanager
def _family() -> Iterator[Family]:
    family = Family()
    try:
        yield family
    finally:
        family.end()


@contextlib.contextmanager
def _revived(family: Family, page: Child | None) -> Iterator[None]:
    """While inside, a page that dies is started again, from a thread of its own."""
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(0.5):
            if page is not None:
                family.revive(page)

    thread = threading.Thread(target=watch, name="page-watch", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


class _Quit:
    """Ctrl-C and SIGTERM: at once while starting, in order (arm held, recording closed) once the session runs; a
    second one cuts the waiting short."""

    def __init__(self) -> None:
        self._inbox: IntentInbox | None = None
        self._asked = 0

    @contextlib.contextmanager
    def on_signals(self) -> Iterator[None]:
        before = {n: signal.signal(n, self._asked_to_end) for n in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def tell(self, inbox: IntentInbox) -> None:
        """From now on a signal is the operator's QUIT."""
        self._inbox = inbox
        if self._asked:
            inbox.put(Intent.QUIT)

    def _asked_to_end(self, *_: object) -> None:
        self._asked += 1
        if self._inbox is None or self._asked > 1:
            raise KeyboardInterrupt
        self._inbox.put(Intent.QUIT)
