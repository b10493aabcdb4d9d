"""A session: many trials in real time under one operator. Drives far_app/trial.py at 30 Hz.

    every tick:   wait for the deadline → attend (newest observation, operator, latch, faults, freshness) → the trial
                  judges, plans and sends → record and show, until the next deadline

Called by `far run` and `far bench loop`. Whatever ends it, the arm is held and the recording closed.
"""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, field, replace

from far_app.alarm import Alarm
from far_app.config import TaskConfig
from far_app.detectors import OperatorOverride
from far_app.errors import RobotError
from far_app.motion import ActionScale
from far_app.protocols import Hold, KeepsWeights, Method, PlanRequest, Robot, RunsOnEngine, SuccessDetector
from far_app.scheduling import LOOP_PRIORITY, real_time_inside
from far_app.session.adaptation import BackgroundAdaptation, unchanged
from far_app.session.board import Board
from far_app.session.clock import TickClock
from far_app.session.inbox import IntentInbox
from far_app.session.lockstep import FinishedAdaptation
from far_app.session.planners import ThreadedPlanner
from far_app.session.publisher import TelemetryPublisher
from far_app.session.realtime import collect_between, collector_off
from far_app.session.recorder import Recorder
from far_app.session.statistics import LoopStatistics
from far_app.session.supervision import Freshness, Supervision, TrialAbandoned
from far_app.session.watched import WatchedRobot
from far_app.session_states import Happening, State
from far_app.trial import (
    NO_ALARM,
    Adapted,
    AfterHold,
    AttemptEnded,
    AttemptStarted,
    Event,
    RunningAdaptation,
    Tick,
    trial,
)
from far_app.types import Adaptation, Attempt, Step, Trial
from far_app.what_if import CorrectFlag

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class SessionSettings:
    name: str
    """The session's folder under recordings/."""
    trials: int = 0
    """0 runs until the operator quits."""
    seed: int = 0
    """Scene seed of the first trial; the next has the next."""
    headless: bool = False
    """Nobody watches: a fault ends the session with an error instead of waiting for an operator."""
    adaptation_limit: float = 60.0
    """Seconds after which a retry no longer waits for its adaptation."""
    freshness: Freshness = field(default_factory=Freshness)
    await_scene: bool = False
    """Real arm: before each trial the arm is held until the operator has rebuilt the scene and cleared the
    workspace."""
    countdown: float = 0.0
    """Real arm: seconds for which each attempt is announced; a pause or a stop cancels it."""
    page_silence: float = math.inf
    """Real arm: seconds without a page that someone looks at after which the arm is held until Resume."""
    first_stretch: int = 1
    """Real arm: ticks that each tick of the session's first attempt takes; that trial is left out of statistics."""


@dataclass(frozen=True, kw_only=True)
class TrialResult:
    """One trial as the summary tells it."""

    seed: int
    attempts: int
    success: bool
    judged_by: str
    counted: bool = True
    """False for a trial that began at reduced speed."""


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
    ) -> None:
        self.settings, self.task, self.scale, self.alarm = settings, task, scale, alarm
        self.planner, self.method, self.recorder, self.statistics = planner, method, recorder, statistics
        self.robot = WatchedRobot(robot, statistics)
        self.detector = OperatorOverride(detector)
        self.clock = TickClock(task.rate)
        self.board = Board(
            task, scale, session=settings.name, method=method.name, trials=settings.trials,
            chunk_horizon=method.policy.spec.horizon,
        )  # fmt: skip
        self.supervision = Supervision(
            robot=self.robot, override=self.detector, planner=planner, recorder=recorder, board=self.board, inbox=inbox,
            clock=self.clock, publisher=publisher, freshness=settings.freshness, headless=settings.headless,
            page_silence=settings.page_silence,
        )  # fmt: skip
        self.results: list[TrialResult] = []
        self.last_failure: Attempt | None = None
        """The newest failed attempt."""
        self._ended = float("nan")
        self._adaptation: BackgroundAdaptation | None = None
        self._attempts: list[Attempt] = []
        self._adaptations: list[Adaptation] = []
        self._seed = self._tick = self._recorded = self._reported = 0
        self._in_attempt = False
        self._stretch = 1

    # ── trials ──────────────────────────────────────────────────────────────────────────────────────────────────────

    def run(self) -> list[TrialResult]:
        """All trials, or until the operator quits. Raises SessionFault (headless), RecordingError and RobotError."""
        supervision, number = self.supervision, 0
        try:
            with real_time_inside(LOOP_PRIORITY) as scheduling, collector_off():
                log.info("the loop is scheduled %s", scheduling)
                self.robot.refresh()
                while self._between_trials():
                    if self.settings.trials and number == self.settings.trials:
                        supervision.happen(Happening.NO_MORE_TRIALS)
                        break
                    if self.settings.await_scene and not supervision.await_scene():
                        break
                    number += 1
                    self._run_trial(number, self.settings.seed + number - 1)
        finally:
            self._finish()
        return self.results

    def _between_trials(self) -> bool:
        """Wait out a stop or a fault; False when the session has ended."""
        try:
            self.supervision.attend("between")
            self.supervision.rest()
        except TrialAbandoned:
            pass
        return self.supervision.state is not State.FINISHED

    def _run_trial(self, number: int, seed: int) -> None:
        """One trial on one scene, whatever becomes of it."""
        supervision = self.supervision
        supervision.happen(Happening.BEGIN_TRIAL)
        supervision.skipping, supervision.marked = False, None
        self._seed, self._attempts, self._adaptations = seed, [], []
        self.board.trial_started(number, seed)
        self.recorder.begin_trial(number, seed)
        supervision.say(f"trial {number}: scene {seed}")
        self._stretch = self.settings.first_stretch if number == 1 else 1
        events = trial(
            seed, self.robot, self.planner, self.method, self.detector, self.task, self.scale, self._start_adaptation,
            self._stretch, self.alarm,
        )  # fmt: skip
        answer: float | None = None
        try:
            while True:
                answer = self._answer(events.send(answer))
        except (StopIteration, TrialAbandoned):
            pass
        except RobotError as error:
            supervision.fault(str(error))
        finally:
            events.close()
            self._end_adaptation()
            self._account()

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
                self._adapted(event.adaptation)
            case PlanRequest():
                raise TypeError("a real-time planner plans by itself and never asks the driver")
        return None

    def _pass_tick(self, tick: Tick) -> float:
        """Bookkeeping of the last tick, then wait for this one's deadline and attend to what happened."""
        self.planner.go()
        if tick.step is not None and tick.step.tick == self._recorded:
            self._record(tick.step)
        self._report()
        if tick.phase == "judging" and not self.board.reason:
            self.board.reason = f"success or failure? Say so within {self.detector.patience:g} s, or it is a failure"
            self.supervision.say(self.board.reason)
        self.supervision.show()
        due = self.clock.wait()
        held = self.supervision.attend(tick.phase)
        if held and tick.phase == "attempt" and self.supervision.state is State.RUNNING:
            self._prime()
            self.clock.restart()
            due = AfterHold(self.clock.wait())
            self.supervision.attend(tick.phase)
        self._tick += not tick.between
        return due

    def _attempt_started(self, event: AttemptStarted) -> None:
        slowly = self._stretch > 1 and event.attempt_index == 1
        pace = f" at 1/{self._stretch} speed, not counted" if slowly else ""
        self.supervision.count_down(self.settings.countdown, f"attempt {event.attempt_index}{pace}")
        self.supervision.happen(Happening.AT_HOME)
        self.supervision.no_lesson = False
        self.board.attempt_started(event.attempt_index, event.policy_version)
        if isinstance(self.method.policy, RunsOnEngine):
            self.board.runs_on(self.method.policy.runs_on)
        self.recorder.begin_attempt(event.attempt_index, event.policy_version)
        if slowly:
            self.supervision.say(f"attempt {event.attempt_index} runs at 1/{self._stretch} of the policy's speed")
            self.recorder.event("reduced_speed", pace.strip(), {"stretch": self._stretch})
        self._recorded = self._tick = 0
        self._in_attempt = True
        self._prime()
        if event.attempt_index > 1:
            self.statistics.homing.append(time.monotonic() - self._ended)
        self.clock.restart()

    def _attempt_ended(self, event: AttemptEnded) -> None:
        attempt, supervision = event.attempt, self.supervision
        for step in attempt.steps[self._recorded :]:
            self._record(step)
        self._report()
        self.recorder.end_attempt(attempt)
        self._in_attempt = False
        self._attempts.append(attempt)
        self.last_failure = self.last_failure if attempt.outcome.success else attempt
        self._ended = time.monotonic()
        word = "success" if attempt.outcome.success else "failure"
        supervision.say(f"attempt {attempt.index}: {word} by {attempt.outcome.judged_by}, {len(attempt.steps)} ticks")
        supervision.rest()
        if supervision.state is State.FINISHED:
            raise TrialAbandoned
        if attempt.outcome.success:
            supervision.happen(Happening.SUCCEEDED)
        else:
            supervision.happen(Happening.FAILED_LAST if event.last or supervision.skipping else Happening.FAILED_RETRY)
        if supervision.skipping:
            raise TrialAbandoned
        collect_between()

    def _account(self) -> None:
        """The trial's row and result; an attempt that was cut off has no outcome and is closed as such."""
        supervision = self.supervision
        if self._in_attempt:
            self._report()
            self._in_attempt = False
            self.recorder.abandon_attempt(self.board.reason or "the session was ended")
        if supervision.marked is not None and self._attempts:
            self._attempts[-1] = replace(self._attempts[-1], outcome=supervision.marked)
            self.recorder.mark(supervision.marked)
        result = Trial(scene_seed=self._seed, attempts=tuple(self._attempts), adaptations=tuple(self._adaptations))
        last = self._attempts[-1].outcome if self._attempts else None
        judged_by = last.judged_by.value if last else ""
        counted = self._stretch == 1
        note = last.note if last else "no attempt was finished"
        self.board.trial_ended(result, judged_by, note if counted else f"began at reduced speed; {note}", counted)
        self.recorder.end_trial(result.success, len(result.attempts))
        self.results.append(
            TrialResult(
                seed=self._seed, attempts=len(result.attempts), success=result.success, judged_by=judged_by,
                counted=counted,
            )
        )  # fmt: skip

    def _finish(self) -> None:
        """Hold the arm, close the recording, show the last state."""
        try:
            self.robot.request(Hold(reason="the session has ended"))
        except RobotError as error:
            log.warning("the last hold: %s", error)
        self.supervision.show()
        self.recorder.close()
        self.planner.close()

    # ── plans, steps, adaptation ────────────────────────────────────────────────────────────────────────────────────

    def _prime(self) -> None:
        """The arm is still: wait for the chunk of the coming tick, so that motion starts without a starved tick."""
        policy, newest = self.method.policy, self.robot.refresh()
        self.planner.prime(
            PlanRequest(
                history=(newest,) * policy.spec.n_obs, tick=self._tick, policy=policy,
                noise_key=(self._seed, self.board.attempt, self._tick),
            )
        )  # fmt: skip

    def _record(self, step: Step) -> None:
        self._recorded = step.tick + 1
        self.statistics.stepped(step)
        self.board.stepped(step)
        self.recorder.add_step(step)

    def _start_adaptation(self, method: Method, attempt: Attempt) -> RunningAdaptation:
        if self.supervision.no_lesson:
            return FinishedAdaptation(unchanged(method.policy.version, "none", attempt.outcome.note))
        self._end_adaptation()
        self._reported = 0
        self.board.adaptation_started()
        self._adaptation = BackgroundAdaptation(method, attempt, self.settings.adaptation_limit)
        return self._adaptation

    def _report(self) -> None:
        """New chunks and gradient steps go to the page and the recording."""
        for chunk in self.planner.handed_out():
            self.board.planned(chunk)
            self.recorder.add_chunk(chunk)
        for asked in self.supervision.inbox.words():
            self._correct(asked)
        if self._adaptation is not None:
            self.board.attributed(self._adaptation.known)
            self._reported = min(self._reported, len(self._adaptation.progress))  # it may have begun anew
        if self._adaptation is not None and len(self._adaptation.progress) > self._reported:
            steps = tuple(self._adaptation.progress)
            for step in steps[self._reported :]:
                self.recorder.add_adaptation_step(step)
            self.board.adaptation_steps, self._reported = steps, len(steps)

    def _correct(self, asked: CorrectFlag) -> None:
        """The operator's word on a chunk: kept, and used when its attempt is the one being learnt from."""
        if asked.session != self.settings.name:
            return self.supervision.say(f"a correction for session '{asked.session}' is not kept here", "warning")
        here = (asked.trial, asked.attempt) == (self.board.trial, self.board.attempt)
        word, running = asked.correction, self._adaptation
        used = here and self.board.adapting and running is not None and running.correct(word)
        detail = {
            "trial": asked.trial, "attempt": asked.attempt, "tick": word.tick, "flagged": word.flagged, "by": word.by,
            "used": used,
        }  # fmt: skip
        self.recorder.event("flag_corrected", "", detail)
        then = "the adaptation begins anew with it" if used else "kept; too late for an adaptation"
        what = "flagged" if word.flagged else "unflagged"
        return self.supervision.say(f"chunk {word.tick} of attempt {asked.attempt} {what} by {word.by}: {then}")

    def _adapted(self, adaptation: Adaptation) -> None:
        self._report()
        self._adaptations.append(adaptation)
        self.board.adapted(adaptation)
        self.recorder.add_adaptation(adaptation)
        weights = self.method.adapted if isinstance(self.method, KeepsWeights) else None
        if weights is not None and weights.version == adaptation.version != adaptation.base_version:
            self.recorder.add_weights(weights, adaptation)
        note = f" ({adaptation.note})" if adaptation.note else ""
        self.supervision.say(f"adaptation: {adaptation.status}, {adaptation.pairs} pairs → {adaptation.version}{note}")

    def _end_adaptation(self) -> None:
        if self._adaptation is not None:
            self._adaptation.cancel(wait=True)
        self._adaptation = None
        self.board.adapting = False
