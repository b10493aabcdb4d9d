"""Everything a session needs, started together and ended together: hw server, page, policy, link. Used by `far run` and
`far bench loop`.

The hw server and the page start first; torch and the checkpoints load in this process meanwhile.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from far_app.cli._person import person_parts
from far_app.cli.assemble import Parts, assemble, check_observation
from far_app.cli.detector import failure_alarm, learned_detector
from far_app.cli.options import RunOptions
from far_app.cli.ports import choose_port
from far_app.cli.preflight import policy_card, preflight
from far_app.cli.processes import Child, Family, run_folder
from far_app.cli.servers import connected, find_hardware, learning, revived, start_page, wait_for_page
from far_app.config import TaskConfig
from far_app.detectors import PersonJudge, TwinCheck
from far_app.endpoints import Endpoints
from far_app.link import RemoteRobot
from far_app.protocols import Method, PlanRequest, Policy, SuccessDetector
from far_app.recording.schema import SessionInfo
from far_app.recording.writer import SessionWriter
from far_app.scheduling import PROMPT_NICENESS, nice_threads
from far_app.session.course import Course
from far_app.session.inbox import IntentInbox
from far_app.session.planners import ThreadedPlanner, plan_one
from far_app.session.publisher import TelemetryPublisher
from far_app.session.realtime import prepare_process
from far_app.session.recorder import Recorder
from far_app.session.review import Keep, drop
from far_app.session.session import Session
from far_app.session.settings import SessionSettings
from far_app.session.shadow import ShadowRobot
from far_app.session.statistics import LoopStatistics
from far_app.tasks import supervised
from far_app.tasks import task as find_task
from far_app.trial_plan.plan import TrialPlan
from hw.camera_config import with_views
from hw.rig import RigConfig
from hw.setup import setup_of
from ui.access import Access

if TYPE_CHECKING:
    from far_app.learning.apart.protocol import Work

COUNTDOWN = 3.0
"""Seconds for which a real arm's attempts are announced."""
PAGE_SILENCE = 2.0
"""Seconds without a page that someone looks at after which a real arm is held."""
NO_TAKE_OVER = "the arm is held in a shadow run"
FIRST_STRETCH = 2
"""Ticks that each tick of a session's first attempt takes on a real arm."""


@dataclass(frozen=True, kw_only=True)
class Stage:
    options: RunOptions
    task: TaskConfig
    rig: RigConfig
    methods: Mapping[str, Parts]
    """What may act, by the name it has here; one but for a plan."""
    robot: RemoteRobot
    folder: Path
    family: Family
    hardware: Child | None
    """The hw server, where it is ours."""
    page: Child | None
    page_url: str

    @property
    def parts(self) -> Parts:
        """What acts, or the first of a plan."""
        return next(iter(self.methods.values()))

    def writer(self, plan: TrialPlan | None = None) -> SessionWriter:
        """A new recording of what this stage is made of. Raises RecordingError."""
        options = self.options
        planned = {"plan": plan.record()} if plan is not None else {}
        return SessionWriter(
            options.recordings,
            SessionInfo(
                task=self.task.name, method=plan.name if plan else options.method, rig=dataclasses.asdict(self.rig),
                policy=self.parts.policy_name, seed=options.seed, cameras=self.parts.method.policy.spec.cameras,
                rate=self.task.rate,
                config={"run": dataclasses.asdict(options), "task": dataclasses.asdict(self.task), **planned},
            ),
        )  # fmt: skip

    def _hardware_rules(self) -> dict[str, Any]:
        """What a session on a real arm has that one on the twin has not."""
        if self.rig.robot != "xarm":
            return {}
        watched = self.page is not None
        return {
            "countdown": COUNTDOWN if watched else 0.0, "await_scene": watched,
            "page_silence": PAGE_SILENCE if watched else math.inf,
            "first_stretch": 1 if self.options.full_speed else FIRST_STRETCH,
        }  # fmt: skip

    @contextlib.contextmanager
    def detector(self) -> Iterator[SuccessDetector]:
        """Who judges this stage's attempts, below the operator."""
        options = self.options
        wait = 0.0 if options.headless else options.judge_wait
        if options.detector is not None:
            with learned_detector(options, wait) as detector:
                yield detector
        elif self.task.judge == "person":
            yield PersonJudge(wait)
        else:
            yield TwinCheck(self.task.success_ticks)

    @contextlib.contextmanager
    def session(
        self, writer: SessionWriter, inbox: IntentInbox, statistics: LoopStatistics, method: Method | None = None, *,
        course: Course | None = None, demonstrate: Literal["", "teleop", "hand"] = "", keep: Keep = drop,
    ) -> Iterator[Session]:  # fmt: skip
        """A session on this stage, with the page told about it and revived when it dies; of attempts, of a plan's
        (`course`), or of a person's demonstrations."""
        options = self.options
        publisher = None
        if options.rerun:
            self.family.add(Child("rrd", "far_app.cli.rrd", [str(writer.folder)], self.folder, patience=30.0))
        if self.page is not None:
            publisher = TelemetryPublisher(Endpoints.in_folder(self.folder).telemetry, statistics.health)
        try:
            with revived(self.family, self.page), self.detector() as detector:
                robot = ShadowRobot(self.robot) if options.shadow else self.robot
                session = Session(
                    settings=SessionSettings(
                        name=writer.folder.name, trials=options.trials, seed=options.seed, headless=options.headless,
                        adaptation_limit=options.retry.adaptation_limit, demonstrate=demonstrate,
                        no_take_over=NO_TAKE_OVER if options.shadow else "", **self._hardware_rules(),
                    ),
                    robot=robot, planner=ThreadedPlanner(), method=method or self.parts.method,
                    detector=detector, task=self.task, scale=self.rig.scale_for(self.task),
                    recorder=Recorder(writer), inbox=inbox, statistics=statistics, publisher=publisher,
                    alarm=failure_alarm(options), course=course, keep=keep,
                )  # fmt: skip
                if options.shadow:
                    session.standing.say("shadow run: plans are shown, the arm is held", "warning")
                yield session
        finally:
            if publisher is not None:
                publisher.close()


Assembling = Callable[[RunOptions, TaskConfig, "Callable[[], Work]"], Mapping[str, Parts]]


def one_method(options: RunOptions, task: TaskConfig, work: Callable[[], Work]) -> Mapping[str, Parts]:
    """What the options themselves ask for."""
    parts = assemble(
        options.method, task, options.policy, options.critic, options.device, options.retry, options.engine,
        threads=options.torch_threads, work=work,
    )  # fmt: skip
    return {options.method: parts}


@contextlib.contextmanager
def stage(options: RunOptions, assembling: Assembling = one_method, *, person: bool = False) -> Iterator[Stage]:
    """Start everything, wait until it is ready, end everything. `person`: nobody else acts, no policy is loaded. Raises
    the FarError of whatever cannot start."""
    rig = options.load_rig()
    task = with_views(find_task(options.task, rig.arm), rig.cameras)
    task = task if rig.robot == "twin" else supervised(task)
    access = None if options.headless else Access.at(options.page_host, options.page_token)
    port = 0 if options.headless else choose_port(options.page_host, options.port)
    with run_folder() as folder, contextlib.ExitStack() as stack:
        family = Family()
        stack.callback(family.end)
        hardware, rig = find_hardware(folder, family, options, rig)
        page = None if options.headless else family.add(start_page(folder, options, port, task.cameras))
        work = stack.enter_context(learning(folder, family, options))
        methods = {"": person_parts(task, rig.policy_image)} if person else assembling(options, task, work)
        parts = next(iter(methods.values()))
        attempts = options.max_attempts or parts.max_attempts or task.max_attempts
        task = dataclasses.replace(task, max_attempts=1 if options.shadow else attempts)
        # From here on this process's threads come before the machine's others: one that is not scheduled while it holds
        # the interpreter would keep the loop waiting. The processes above were started before, at the usual priority.
        nice_threads(PROMPT_NICENESS)
        stack.callback(nice_threads, 0)
        robot = stack.enter_context(connected(folder, hardware))
        if page is not None:
            wait_for_page(page, options.page_host, port)
        for parts in methods.values():
            check_observation(parts.method.policy.spec, robot.observe())
            if not person:
                preflight(
                    parts.method.policy.spec, policy_card(task.name, parts.checkpoint), setup_of(rig, task),
                    robot.observe(), options.accept_differences or options.shadow,
                )  # fmt: skip
        prepare_process(options.torch_threads)
        for parts in methods.values():
            warm_up(parts.method.policy, robot)
        yield Stage(
            options=options, task=task, rig=rig, methods=methods, robot=robot, folder=folder, family=family,
            hardware=hardware, page=page, page_url=access.url(port) if access is not None else "",
        )  # fmt: skip


def warm_up(policy: Policy, robot: RemoteRobot) -> None:
    """A few chunks before the clock matters: the first ones of a network take many times the later ones."""
    history = (robot.observe(),) * policy.spec.n_obs
    for i in range(3):
        plan_one(PlanRequest(history=history, tick=i, noise_key=(0, 0, i), policy=policy))
