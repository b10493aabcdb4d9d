"""A session: many trials in real time under one operator, at 30 Hz.

    every tick:   wait for the deadline → attend (newest observation, operator, latch, faults, freshness) → the trial
                  judges, plans and sends → record and show, until the next deadline

far_app/trial.py says what a trial is, driver.py what each of its events asks for, supervision.py what else may happen.

Called by `far run` and `far bench loop`. Whatever ends it, the arm is held and the recording closed.
"""

from __future__ import annotations

import logging
from dataclasses import replace

from far_app.alarm import Alarm
from far_app.attempt import NO_ALARM, Setting
from far_app.config import TaskConfig
from far_app.detectors import OperatorOverride
from far_app.errors import RobotError
from far_app.events import TrialEvents
from far_app.guided import guided_trial
from far_app.motion import ActionScale
from far_app.protocols import Distant, Hold, Method, Robot, SuccessDetector
from far_app.scheduling import LOOP_PRIORITY, real_time_inside
from far_app.session.board import Board
from far_app.session.clock import TickClock
from far_app.session.course import Assignment, Consecutive, Course, Demonstrations
from far_app.session.driver import Driver
from far_app.session.inbox import IntentInbox
from far_app.session.lessons import Lessons
from far_app.session.marking import Marking
from far_app.session.operator import Operator
from far_app.session.planners import ThreadedPlanner
from far_app.session.publisher import TelemetryPublisher
from far_app.session.realtime import collector_off
from far_app.session.recorder import Recorder
from far_app.session.review import Keep, Review, drop
from far_app.session.settings import SessionSettings, TrialResult
from far_app.session.standing import Standing
from far_app.session.statistics import LoopStatistics
from far_app.session.steering import Helper
from far_app.session.supervision import Supervision, TrialAbandoned
from far_app.session.versions import VersionKeeper
from far_app.session.watched import WatchedRobot
from far_app.session_states import Happening, Intent, State
from far_app.trial import trial
from far_app.types import Trial

log = logging.getLogger(__name__)


class Session:
    def __init__(
        self,
        *,
        settings: SessionSettings,
        robot: Robot,
        planner: ThreadedPlanner,
        method: Method,
        detector: SuccessDetector,
        task: TaskConfig,
        scale: ActionScale,
        recorder: Recorder,
        inbox: IntentInbox,
        statistics: LoopStatistics,
        publisher: TelemetryPublisher | None = None,
        alarm: Alarm = NO_ALARM,
        course: Course | None = None,
        keep: Keep = drop,
    ) -> None:
        """`course`: which trial comes next; by default `method` on `settings.trials` scenes from `settings.seed` on.
        `keep` takes a demonstration that the operator keeps."""
        self.settings, self.task, self.scale, self.alarm = settings, task, scale, alarm
        usual = Demonstrations if settings.demonstrate else Consecutive
        self.course: Course = course or usual(method, seed=settings.seed, trials=settings.trials)
        self.planner, self.recorder, self.statistics = planner, recorder, statistics
        self.robot = WatchedRobot(robot, statistics)
        self.detector = OperatorOverride(detector)
        self.clock = TickClock(task.rate, robot if isinstance(robot, Distant) else None)
        self.board = Board(
            task, scale, session=settings.name, method=method.name, trials=settings.trials,
            chunk_horizon=method.policy.spec.horizon,
        )  # fmt: skip
        self.standing = Standing(
            robot=self.robot, override=self.detector, recorder=recorder, board=self.board, publisher=publisher,
        )  # fmt: skip
        self.standing.withheld[Intent.TAKE_OVER] = settings.no_take_over
        self.helper = Helper(self.standing, inbox, scale)
        marking = Marking(self.standing, settings.name)
        self.versions = VersionKeeper(self.standing, method, recorder.folder, self.course.fixed)
        self.inbox = inbox
        self.operator = Operator(inbox, self.standing, self.helper, marking, self.versions, self.clock.period)
        self.supervision = Supervision(
            standing=self.standing, operator=self.operator, helper=self.helper, planner=planner, clock=self.clock,
            freshness=settings.freshness, headless=settings.headless, page_silence=settings.page_silence,
        )  # fmt: skip
        self.lessons = Lessons(self.standing, self.versions, session=settings.name, limit=settings.adaptation_limit)
        self.review = Review(self.standing, self.supervision, self.operator, keep)
        if settings.demonstrate:
            self.standing.withheld[Intent.HAND_BACK] = "a demonstration has no policy to hand back to"
        self.driver = Driver(
            settings=settings, planner=planner, inbox=inbox, statistics=statistics, clock=self.clock,
            detector=self.detector, standing=self.standing, supervision=self.supervision, helper=self.helper,
            operator=self.operator, versions=self.versions, lessons=self.lessons,
        )  # fmt: skip
        self.results: list[TrialResult] = []

    # ── trials ──────────────────────────────────────────────────────────────────────────────────────────────────────

    def run(self) -> list[TrialResult]:
        """All trials, or until the operator quits. Raises SessionFault (headless), RecordingError and RobotError."""
        number = 0
        try:
            with real_time_inside(LOOP_PRIORITY) as scheduling, collector_off():
                log.info("the loop is scheduled %s", scheduling)
                self.robot.refresh()
                while self._between_trials():
                    asked = self.course.next()
                    self.board.plan = self.course.shown()
                    if asked is None:
                        self.standing.happen(Happening.NO_MORE_TRIALS)
                        break
                    self.board.trial_awaited(asked.label, blind=asked.blind)
                    if self.settings.await_scene and not self.supervision.await_scene(asked.gate):
                        break
                    number += 1
                    result = self._run_trial(number, asked)
                    if isinstance(self.course, Demonstrations):
                        result = replace(result, word=self._reviewed(self.course.kept))
                    self.course.ended(asked, result)
                    self.board.plan = self.course.shown()
        finally:
            self._finish()
        return self.results

    def _reviewed(self, kept: int) -> Intent:
        """The operator's word on the demonstration that has just ended; one that was cut off is discarded."""
        if self.standing.state is State.FINISHED or not self.driver.attempts:
            return Intent.DISCARD
        try:
            return self.review.ask(self.driver.attempts[-1], kept, self.settings.trials)
        except TrialAbandoned:
            return Intent.DISCARD

    def _between_trials(self) -> bool:
        """Wait out a stop or a fault; False when the session has ended."""
        try:
            self.supervision.attend("between")
            self.supervision.rest()
        except TrialAbandoned:
            pass
        return self.standing.state is not State.FINISHED

    def _run_trial(self, number: int, asked: Assignment) -> TrialResult:
        """One trial on one scene, whatever becomes of it."""
        self.standing.trial_begins()
        chance = asked.seed if asked.chance is None else asked.chance
        stretch = self.settings.first_stretch if number == 1 else 1
        self.driver.trial_begins(asked.method, chance, stretch)
        task = replace(self.task, max_attempts=asked.max_attempts or self.task.max_attempts)
        self.lessons.trial_begins()
        self.versions.trial_begins()
        self.board.trial_started(number, asked.seed, task.max_attempts)
        self.recorder.begin_trial(number, asked.seed, asked.record)
        if asked.gate is not None and self.settings.await_scene and self.robot.newest is not None:
            self.recorder.scene(asked.gate.accepted(self.robot.newest))
        self.standing.say(f"trial {number}: scene {asked.seed}")
        events = self._events(asked, task, chance, stretch)
        answer: float | None = None
        try:
            while True:
                answer = self.driver.answer(events.send(answer))
        except (StopIteration, TrialAbandoned):
            pass
        except RobotError as error:
            self.standing.fault(str(error))
        finally:
            events.close()
            self.lessons.end()
            result = self._account(asked.seed, task.max_attempts)
        return result

    def _events(self, asked: Assignment, task: TaskConfig, chance: int, stretch: int) -> TrialEvents:
        """What happens on this scene: Algorithm 1, or a person leading the arm by hand."""
        setting = Setting(
            robot=self.robot, planner=self.planner, detector=self.detector, task=task, scale=self.scale,
            alarm=self.alarm, person=self.helper, stretch=stretch,
        )  # fmt: skip
        if self.settings.demonstrate == "hand":
            return guided_trial(asked.seed, setting)
        return trial(asked.seed, asked.method, setting, self.lessons.start, chance)

    def _account(self, seed: int, max_attempts: int) -> TrialResult:
        """The trial's row and result."""
        standing, attempts = self.standing, self.driver.attempts
        self.driver.cut_off(self.board.reason or "the session was ended")
        if standing.marked is not None and attempts:
            attempts[-1] = replace(attempts[-1], outcome=standing.marked)
            self.recorder.mark(standing.marked)
        result = Trial(scene_seed=seed, attempts=tuple(attempts), adaptations=tuple(self.lessons.learnt))
        last = attempts[-1].outcome if attempts else None
        judged_by = last.judged_by.value if last else ""
        helped = any(step.intervention for attempt in attempts for step in attempt.steps)
        counted = self.driver.stretch == 1 and not helped
        remarks = ["began at reduced speed"] * (self.driver.stretch > 1) + ["a person helped"] * helped
        note = "; ".join([*remarks, last.note if last else "no attempt was finished"])
        self.board.trial_ended(result, judged_by, note, counted)
        self.recorder.end_trial(result.success, len(result.attempts))
        tried = len(result.attempts) >= max_attempts and not standing.skipping
        self.results.append(
            TrialResult(
                seed=seed, attempts=len(result.attempts), success=result.success, judged_by=judged_by,
                counted=counted, finished=result.success or tried,
            )
        )  # fmt: skip
        return self.results[-1]

    def _finish(self) -> None:
        """Hold the arm, close the recording, show the last state."""
        try:
            self.robot.request(Hold(reason="the session has ended"))
        except RobotError as error:
            log.warning("the last hold: %s", error)
        self.standing.show()
        self.recorder.close()
        self.planner.close()
