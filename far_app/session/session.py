"""A session: many trials in real time under one operator. Drives far_app/trial.py at 30 Hz.

    every tick:   wait for the deadline → attend (newest observation, operator, latch, faults, freshness) → the trial
                  judges, plans and sends → record and show, until the next deadline

Called by `far run` and `far bench loop`. Whatever ends it, the arm is held and the recording closed.
"""

from __future__ import annotations

import logging
import time
from dataclasses import replace

from far_app.alarm import Alarm
from far_app.config import TaskConfig
from far_app.detectors import OperatorOverride
from far_app.errors import RobotError
from far_app.guided import guided_trial
from far_app.motion import ActionScale
from far_app.protocols import EngineReport, Hold, Method, PlanRequest, Robot, RunsOnEngine, SuccessDetector
from far_app.scheduling import LOOP_PRIORITY, real_time_inside
from far_app.session.board import Board
from far_app.session.clock import TickClock
from far_app.session.course import Assignment, Consecutive, Course, Demonstrations
from far_app.session.inbox import IntentInbox
from far_app.session.lessons import Lessons
from far_app.session.marking import Marking
from far_app.session.operator import Operator
from far_app.session.planners import ThreadedPlanner
from far_app.session.publisher import TelemetryPublisher
from far_app.session.realtime import collect_between, collector_off
from far_app.session.recorder import Recorder
from far_app.session.review import Keep, Review, drop
from far_app.session.settings import SessionSettings, TrialResult
from far_app.session.standing import IN_ATTEMPT, Standing
from far_app.session.statistics import LoopStatistics
from far_app.session.steering import Helper
from far_app.session.supervision import Supervision, TrialAbandoned
from far_app.session.timeline import AGGREGATE, INFER, OBSERVE, PUBLISH, RECORD
from far_app.session.versions import VersionKeeper
from far_app.session.watched import WatchedRobot
from far_app.session_states import Happening, Intent, State
from far_app.trial import (
    NO_ALARM,
    Adapted,
    AfterHold,
    AttemptEnded,
    AttemptStarted,
    Event,
    Tick,
    TrialEvents,
    trial,
)
from far_app.types import Attempt, Step, Trial
from far_app.what_if import CorrectFlag

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
        self.planner, self.method, self.recorder, self.statistics = planner, method, recorder, statistics
        self.robot = WatchedRobot(robot, statistics)
        self.detector = OperatorOverride(detector)
        self.clock = TickClock(task.rate)
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
        self.inbox, self.operator = (
            inbox,
            Operator(inbox, self.standing, self.helper, marking, self.versions, self.clock.period),
        )
        self.supervision = Supervision(
            standing=self.standing, operator=self.operator, helper=self.helper, planner=planner, clock=self.clock,
            freshness=settings.freshness, headless=settings.headless, page_silence=settings.page_silence,
        )  # fmt: skip
        self.lessons = Lessons(self.standing, self.versions, session=settings.name, limit=settings.adaptation_limit)
        self.review = Review(self.standing, self.supervision, self.operator, keep)
        if settings.demonstrate:
            self.standing.withheld[Intent.HAND_BACK] = "a demonstration has no policy to hand back to"
        self.results: list[TrialResult] = []
        self.last_failure: Attempt | None = None
        """The newest failed attempt."""
        self._ended = float("nan")
        self._attempts: list[Attempt] = []
        self._chance = self._tick = self._recorded = 0
        self._in_attempt = False
        self._stretch = 1

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
        if self.standing.state is State.FINISHED or not self._attempts:
            return Intent.DISCARD
        try:
            return self.review.ask(self._attempts[-1], kept, self.settings.trials)
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
        self.method, self._attempts = asked.method, []
        self._chance = asked.seed if asked.chance is None else asked.chance
        task = replace(self.task, max_attempts=asked.max_attempts or self.task.max_attempts)
        self.lessons.trial_begins()
        self.versions.trial_begins()
        self.board.trial_started(number, asked.seed, task.max_attempts)
        self.recorder.begin_trial(number, asked.seed, asked.record)
        if asked.gate is not None and self.settings.await_scene and self.robot.newest is not None:
            self.recorder.scene(asked.gate.accepted(self.robot.newest))
        self.standing.say(f"trial {number}: scene {asked.seed}")
        self._stretch = self.settings.first_stretch if number == 1 else 1
        events = self._events(asked.seed, task)
        answer: float | None = None
        try:
            while True:
                answer = self._answer(events.send(answer))
        except (StopIteration, TrialAbandoned):
            pass
        except RobotError as error:
            self.standing.fault(str(error))
        finally:
            events.close()
            self.lessons.end()
            result = self._account(asked.seed, task.max_attempts)
        return result

    def _events(self, seed: int, task: TaskConfig) -> TrialEvents:
        """What happens on this scene: Algorithm 1, or a person leading the arm by hand."""
        if self.settings.demonstrate == "hand":
            return guided_trial(seed, self.robot, self.detector, task, self.scale, self.helper)
        return trial(
            seed, self.robot, self.planner, self.method, self.detector, task, self.scale, self.lessons.start,
            self._stretch, self.alarm, self.helper, self._chance,
        )  # fmt: skip

    def _answer(self, event: Event) -> float | None:
        """What the trial's event asks of a driver in real time."""
        match event:
            case Tick():
                return self._pass_tick(event)
            case AttemptStarted():
                self._attempt_started(event)
            case AttemptEnded():
                self._attempt_ended(event)
            case Adapted():
                self.lessons.adapted(event.adaptation, self.method)
            case PlanRequest():
                raise TypeError("a real-time planner plans by itself and never asks the driver")
        return None

    def _pass_tick(self, tick: Tick) -> float:
        """Bookkeeping of the last tick, then wait for this one's deadline and attend to what happened."""
        timeline = self.statistics.timeline
        self.planner.go()
        timeline.lap(AGGREGATE)
        if tick.step is not None and tick.step.tick == self._recorded:
            self._record(tick.step)
        self._report()
        timeline.lap(RECORD)
        if tick.phase == "judging" and not self.board.reason:
            self.board.reason = f"success or failure? Say so within {self.detector.patience:g} s, or it is a failure"
            self.standing.say(self.board.reason)
        self.standing.show()
        timeline.lap(PUBLISH)
        due = self.clock.wait()
        timeline.begin(self._tick - tick.between if tick.phase == "attempt" else -1, due)
        held = self.supervision.attend(tick.phase)
        if held and tick.phase == "attempt" and self.standing.state in IN_ATTEMPT:
            if self.settings.demonstrate != "hand":
                self._prime()
            self.clock.restart()
            due = AfterHold(self.clock.wait())
            timeline.restart()
            self.supervision.attend(tick.phase)
        elif held:
            timeline.restart()
        timeline.lap(OBSERVE)
        self._tick += not tick.between
        return due

    def _attempt_started(self, event: AttemptStarted) -> None:
        slowly = self._stretch > 1 and event.attempt_index == 1
        pace = f" at 1/{self._stretch} speed, not counted" if slowly else ""
        self.supervision.count_down(self.settings.countdown, f"attempt {event.attempt_index}{pace}")
        self.standing.happen(Happening.AT_HOME)
        self.standing.no_lesson = False
        self.helper.attempt_begins()
        version = self.versions.attempt_begins(event.policy_version)
        self.board.attempt_started(event.attempt_index, version)
        if isinstance(self.method.policy, RunsOnEngine):
            self._runs_on(self.method.policy.runs_on)
        self.recorder.begin_attempt(event.attempt_index, version)
        if slowly:
            self.standing.say(f"attempt {event.attempt_index} runs at 1/{self._stretch} of the policy's speed")
            self.recorder.event("reduced_speed", pace.strip(), {"stretch": self._stretch})
        self._recorded = self._tick = 0
        self._in_attempt = True
        if self.settings.demonstrate:
            self.operator.ask(Intent.TAKE_OVER, "attempt")
        if self.settings.demonstrate != "hand":
            self._prime()
        if event.attempt_index > 1:
            self.statistics.homing.append(time.monotonic() - self._ended)
        self.clock.restart()

    def _runs_on(self, engine: EngineReport) -> None:
        """Show and record what runs the policy; what was refused (and logged where it was) is told once."""
        known = self.board.engine
        for refused in engine.refused[len(known.refused) :]:
            self.board.log(f"engine refused, {refused}; {engine.name} runs the policy", "warning")
        if engine != known:
            self.recorder.event("engine", engine.name, {"why": engine.why, "refused": list(engine.refused)})
        self.board.engine = engine

    def _attempt_ended(self, event: AttemptEnded) -> None:
        attempt, standing = event.attempt, self.standing
        for step in attempt.steps[self._recorded :]:
            self._record(step)
        self._report(all_times=True)
        self.recorder.end_attempt(attempt)
        self.board.history.attempt_ended(self.board.trial, attempt)
        self.versions.attempt_ended(attempt.outcome.success)
        self._in_attempt = False
        self._attempts.append(attempt)
        self.last_failure = self.last_failure if attempt.outcome.success else attempt
        self._ended = time.monotonic()
        word = "success" if attempt.outcome.success else "failure"
        standing.say(f"attempt {attempt.index}: {word} by {attempt.outcome.judged_by}, {len(attempt.steps)} ticks")
        self.supervision.rest()
        if standing.state is State.FINISHED:
            raise TrialAbandoned
        if attempt.outcome.success:
            standing.happen(Happening.SUCCEEDED)
        else:
            standing.happen(Happening.FAILED_LAST if event.last or standing.skipping else Happening.FAILED_RETRY)
        if standing.skipping:
            raise TrialAbandoned
        collect_between()

    def _account(self, seed: int, max_attempts: int) -> TrialResult:
        """The trial's row and result; an attempt that was cut off has no outcome and is closed as such."""
        standing = self.standing
        if self._in_attempt:
            self._report(all_times=True)
            self._in_attempt = False
            self.recorder.abandon_attempt(self.board.reason or "the session was ended")
        if standing.marked is not None and self._attempts:
            self._attempts[-1] = replace(self._attempts[-1], outcome=standing.marked)
            self.recorder.mark(standing.marked)
        result = Trial(scene_seed=seed, attempts=tuple(self._attempts), adaptations=tuple(self.lessons.learnt))
        last = self._attempts[-1].outcome if self._attempts else None
        judged_by = last.judged_by.value if last else ""
        helped = any(step.intervention for attempt in self._attempts for step in attempt.steps)
        counted = self._stretch == 1 and not helped
        remarks = ["began at reduced speed"] * (self._stretch > 1) + ["a person helped"] * helped
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

    # ── plans, steps, adaptation ────────────────────────────────────────────────────────────────────────────────────

    def _prime(self) -> None:
        """The arm is still: wait for the chunk of the coming tick, so that motion starts without a starved tick."""
        policy, newest = self.method.policy, self.robot.refresh()
        self.planner.prime(
            PlanRequest(
                history=(newest,) * policy.spec.n_obs, tick=self._tick, policy=policy,
                noise_key=(self._chance, self.board.attempt, self._tick),
            )
        )  # fmt: skip

    def _record(self, step: Step) -> None:
        self._recorded = step.tick + 1
        self.statistics.stepped(step)
        self.board.stepped(step)
        self.recorder.add_step(step)

    def _report(self, *, all_times: bool = False) -> None:
        """New chunks, the operator's words on them and what is being learnt go to the page and the recording; so do the
        attempt's ticks whose times are complete, or all that are left."""
        self.statistics.timeline.elsewhere(INFER, self.planner.spent())
        for times in self.statistics.timeline.settled(all_of_them=all_times):
            self.recorder.add_tick_times(times)
        for chunk in self.planner.handed_out():
            self.board.planned(chunk)
            self.recorder.add_chunk(chunk)
        for asked in self.inbox.take(CorrectFlag):
            self.lessons.correct(asked)
        self.lessons.report()
