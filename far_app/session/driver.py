"""Drives one trial after another in real time: answers each of far_app/events.py.

    Tick             record and show the last one, wait for this one's deadline, attend to what happened meanwhile
    AttemptStarted   count down, open the recording, wait for the first chunk
    AttemptEnded     close it, say how it went
    Adapted          the lesson's end

Called by session.
"""

from __future__ import annotations

import logging
import time

from far_app.detectors import OperatorOverride
from far_app.events import Adapted, AfterHold, AttemptEnded, AttemptStarted, Event, Tick
from far_app.protocols import EngineReport, Method, PlanRequest, RunsOnEngine
from far_app.session.clock import TickClock
from far_app.session.inbox import IntentInbox
from far_app.session.lessons import Lessons
from far_app.session.operator import Operator
from far_app.session.planners import ThreadedPlanner
from far_app.session.realtime import collect_between, keep_interpreter, share_interpreter
from far_app.session.settings import SessionSettings
from far_app.session.standing import IN_ATTEMPT, Standing
from far_app.session.statistics import LoopStatistics
from far_app.session.steering import Helper
from far_app.session.supervision import Supervision, TrialAbandoned
from far_app.session.timeline import AGGREGATE, INFER, OBSERVE, PUBLISH, RECORD
from far_app.session.versions import VersionKeeper
from far_app.session_states import Happening, Intent, State
from far_app.types import Attempt, Step
from far_app.what_if import CorrectFlag

log = logging.getLogger(__name__)


class Driver:
    def __init__(
        self, *, settings: SessionSettings, planner: ThreadedPlanner, inbox: IntentInbox, statistics: LoopStatistics,
        clock: TickClock, detector: OperatorOverride, standing: Standing, supervision: Supervision, helper: Helper,
        operator: Operator, versions: VersionKeeper, lessons: Lessons,
    ) -> None:  # fmt: skip
        self.settings, self.planner, self.inbox = settings, planner, inbox
        self.statistics, self.clock = statistics, clock
        self.robot, self.recorder, self.board = standing.robot, standing.recorder, standing.board
        self.detector, self.standing, self.supervision, self.helper = detector, standing, supervision, helper
        self.operator, self.versions, self.lessons = operator, versions, lessons
        self.method: Method
        self.attempts: list[Attempt] = []
        """Those of this trial that have ended."""
        self.last_failure: Attempt | None = None
        """The newest failed attempt."""
        self.in_attempt = False
        self.recorded = 0
        """Steps of the running attempt."""
        self.stretch = 1
        """How many times slower than the policy's pace the first attempt runs."""
        self._chance = self._tick = 0
        self._ended = float("nan")

    def trial_begins(self, method: Method, chance: int, stretch: int) -> None:
        """`chance` keys the noise."""
        self.method, self.attempts, self._chance, self.stretch = method, [], chance, stretch

    def cut_off(self, reason: str) -> None:
        """An attempt that is still under way has no outcome and is closed as such."""
        if self.in_attempt:
            self._report(all_times=True)
            self.in_attempt = False
            self.recorder.abandon_attempt(reason)

    def answer(self, event: Event) -> float | None:
        """What the trial's event asks of a driver in real time."""
        share_interpreter()
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
        if tick.phase == "attempt":
            self.clock.sent()
        self.planner.go()
        timeline.lap(AGGREGATE)
        if tick.step is not None and tick.step.tick == self.recorded:
            self._record(tick.step)
        self._report()
        timeline.lap(RECORD)
        if tick.phase == "judging" and not self.board.reason:
            self.board.reason = f"success or failure? Say so within {self.detector.patience:g} s, or it is a failure"
            self.standing.say(self.board.reason)
        self.standing.show()
        timeline.lap(PUBLISH)
        due = self.clock.wait()
        keep_interpreter()  # until the target is on its way: the trial's next event
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
        slowly = self.stretch > 1 and event.attempt_index == 1
        pace = f" at 1/{self.stretch} speed, not counted" if slowly else ""
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
            self.standing.say(f"attempt {event.attempt_index} runs at 1/{self.stretch} of the policy's speed")
            self.recorder.event("reduced_speed", pace.strip(), {"stretch": self.stretch})
        self.recorded = self._tick = 0
        self.in_attempt = True
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
        for step in attempt.steps[self.recorded :]:
            self._record(step)
        self._report(all_times=True)
        self.recorder.end_attempt(attempt)
        self.board.history.attempt_ended(self.board.trial, attempt)
        self.versions.attempt_ended(attempt.outcome.success)
        self.in_attempt = False
        self.attempts.append(attempt)
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

    # ── bookkeeping ─────────────────────────────────────────────────────────────────────────────────────────────────

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
        self.recorded = step.tick + 1
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
