"""What may interrupt a trial at any tick: the operator, a latch, a fault, stale observations, a policy gone wrong.

Keeps the session's state (far_app/session_states.py) and is asked once a tick (`attend`); `rest` waits, with the arm
held, until the operator lets things go on.
"""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass

from far_app.detectors import OperatorOverride
from far_app.errors import FarError, RobotError
from far_app.protocols import Heartbeat, Hold, Home, Resume
from far_app.session.board import Board
from far_app.session.clock import TickClock
from far_app.session.inbox import IntentInbox
from far_app.session.planners import ThreadedPlanner
from far_app.session.publisher import RATE, TelemetryPublisher
from far_app.session.recorder import Recorder
from far_app.session.watched import WatchedRobot
from far_app.session_states import Event, Happening, Intent, State, refusal, step
from far_app.types import Judge, Outcome, RobotMode, RobotStatus

log = logging.getLogger(__name__)

RESTING = (State.PAUSED, State.STOPPED, State.FAULT)
MOVING = (State.HOMING, State.RUNNING, State.ADAPTING)
"""States in which the arm may move."""


class SessionFault(FarError):
    """The session met a fault and nobody is there to clear it."""


class TrialAbandoned(Exception):
    """Unwinds a trial that ends outside its own course: skipped, marked while adapting, the session ended."""


@dataclass(frozen=True, kw_only=True)
class Freshness:
    stale_after: float = 0.25
    """Age of an observation's pictures, seconds, at which the arm is held."""
    limit: float = 1.0
    """Seconds of staleness after which it is a fault."""


class Supervision:
    def __init__(
        self,
        *,
        robot: WatchedRobot,
        override: OperatorOverride,
        planner: ThreadedPlanner,
        recorder: Recorder,
        board: Board,
        inbox: IntentInbox,
        clock: TickClock,
        publisher: TelemetryPublisher | None,
        freshness: Freshness,
        headless: bool,
        page_silence: float = math.inf,
    ) -> None:
        self.robot, self.override, self.planner, self.recorder = robot, override, planner, recorder
        self.board, self.inbox, self.clock, self.publisher = board, inbox, clock, publisher
        self.freshness, self.headless = freshness, headless
        self.page_silence = page_silence
        """Seconds without a page that someone looks at, after which the arm is held."""
        self.state = State.READY
        self.skipping = False
        """The operator skips this trial: it ends with its running attempt."""
        self.no_lesson = False
        """The attempt was ended by a stop or by trouble of ours: nothing to learn from."""
        self.marked: Outcome | None = None
        """The operator's word on an attempt that had already ended."""
        self._shown = 0.0

    def happen(self, event: Event) -> None:
        """The state that follows."""
        before, self.state = self.state, step(self.state, event)
        if before is not self.state:
            log.info("%s → %s (%s)", before, self.state, event)
            self.recorder.event("state", self.state.value, {"from": before.value, "by": event.value})
            if self.state not in RESTING:
                self.board.reason = ""

    def say(self, text: str, level: str = "info") -> None:
        """One line for the page and the log."""
        log.log(logging.getLevelNamesMapping()[level.upper()], text)
        self.board.log(text, level)

    def show(self) -> None:
        """Leave a snapshot for the page, at its rate."""
        now = time.monotonic()
        if self.publisher is not None and now - self._shown > 0.9 / RATE:
            self._shown = now
            self.publisher.show(self.board.telemetry(self.state, self.robot.newest))

    # ── asked once a tick ───────────────────────────────────────────────────────────────────────────────────────────

    def attend(self, phase: str) -> bool:
        """Look at what happened since the last tick; True when the arm was held and motion must start afresh.

        In an attempt, a stop or a fault is ruled on and the trial ends the attempt by itself; on the way home it is
        waited out here. Raises TrialAbandoned where the trial must not go on."""
        self._fetch()
        self._drain(phase)
        self._notice(phase)
        held = phase == "attempt" and self.state is State.RUNNING and self._wait_while_stale()
        if self.state is State.PAUSED or (phase == "homing" and self.state in RESTING):
            interrupted = State.ADAPTING if self.board.adapting else State.HOMING
            self.rest(phase)
            held = True
            if self.state is State.READY and phase == "homing":
                self.robot.request(Home())
                self.happen(Happening.GO_ON_ADAPTING if interrupted is State.ADAPTING else Happening.GO_ON_HOMING)
            elif self.state is State.READY:
                self.happen(Happening.GO_ON_ATTEMPT)
        if self.state is State.FINISHED or (phase == "homing" and self.state is State.TRIAL_DONE):
            raise TrialAbandoned
        return held

    def rest(self, phase: str = "") -> None:
        """Wait, the arm held, while the state is one of rest. Raises SessionFault on a fault nobody can clear."""
        while self.state in RESTING:
            if self.headless and self.state is State.FAULT:
                raise SessionFault(self.board.reason)
            if phase == "attempt" and self.state is not State.PAUSED:
                return  # ruled on: the trial ends the attempt
            self.show()
            time.sleep(self.clock.period)
            self._fetch()
            self._drain(phase)
            self._notice(phase)
        self.clock.restart()

    def await_scene(self) -> bool:
        """Hold until the operator has rebuilt the scene and says that the workspace is clear; False when the session
        ended instead."""
        self._hold("waiting for the scene")
        while self.state is not State.FINISHED:
            if self.state in (State.READY, State.TRIAL_DONE):
                self.happen(Happening.NEED_SCENE)
            self.show()
            time.sleep(self.clock.period)
            self._fetch()
            for intent in self.inbox.drain():
                asked = self.state
                self._ask(intent, "between")
                if asked is State.AWAITING_SCENE and self.state is State.READY:
                    return True
            self._notice("between")
            self.rest("between")
        return False

    def count_down(self, seconds: float, what: str) -> None:
        """Announce a motion; it begins when the time is over and the arm still stands at home. A pause or a stop
        cancels it, and after Resume it is announced anew. Raises TrialAbandoned as `attend` does."""
        begins = time.monotonic() + seconds
        while (left := begins - time.monotonic()) > 0.0:
            self.board.countdown = float(math.ceil(left))
            self.board.reason = f"{what} begins in {math.ceil(left)} s: Pause or STOP cancels"
            self.show()
            time.sleep(self.clock.period)
            self.robot.request(Heartbeat())
            try:
                held = self.attend("homing")
            finally:
                self.board.countdown = 0.0
            if held or (self.robot.newest is not None and not self.robot.newest.status.at_home):
                begins = time.monotonic() + seconds
        self.board.reason = ""

    def fault(self, reason: str, lesson: bool = False) -> None:
        """Hold the arm, end the attempt as a failure (one to learn from or not), explain; only the operator clears
        it."""
        if self.state in (State.FAULT, State.FINISHED):
            return
        self.no_lesson = self.no_lesson or not lesson
        self.override.rule(Outcome(success=False, judged_by=Judge.FAULT, note=reason))
        self.board.reason = reason
        self.happen(Happening.FAULT)
        self.say(reason, "error")
        self._hold(reason)

    # ── what is noticed ─────────────────────────────────────────────────────────────────────────────────────────────

    def _fetch(self) -> None:
        try:
            self.robot.refresh()
        except RobotError as error:
            self.fault(str(error))

    def _notice(self, phase: str) -> None:
        """A latch or a fault of the hw server, a failure of the policy, a recording that stopped (it ends the session:
        attempts that nobody keeps are not worth the risk)."""
        status = self.robot.newest.status if self.robot.newest is not None else RobotStatus(mode=RobotMode.HOLD)
        latched = status.mode is RobotMode.LATCHED
        if latched and status.fault and self.state is not State.FAULT:
            self.fault(status.reason or "the arm reports a fault", lesson=True)  # the policy's own doing
        elif latched and self.state not in (State.STOPPED, State.FAULT, State.FINISHED):
            self._stopped(Happening.LATCH, status.reason or "STOP")
        if phase == "homing" and self.state in (State.HOMING, State.ADAPTING) and status.mode is RobotMode.HOMING:
            self.board.reason = status.reason  # what the way home waits for
        if phase == "attempt" and self.planner.failure is not None:
            self.fault(str(self.planner.failure))
        unseen = time.monotonic() - self.inbox.looked_at
        if self.state in MOVING and unseen > self.page_silence:
            self._hold("nobody has the page open")
            self.happen(Intent.PAUSE)
            self.board.reason = (
                f"nobody has had the page open for {unseen:.1f} s (limit {self.page_silence:g} s): the arm is held; "
                "look at it, then press Resume"
            )
            self.say(self.board.reason, "warning")
        if self.recorder.error is not None:
            self._hold(str(self.recorder.error))
            raise self.recorder.error

    def _wait_while_stale(self) -> bool:
        """Hold while observations are stale; True when they came back in time, else it is a fault."""
        if self.robot.age() <= self.freshness.stale_after:
            return False
        began = time.monotonic()
        self.robot.statistics.stale_holds += 1
        self.board.reason = "observations are stale; the arm is held"
        self.recorder.event("stale", self.board.reason, {"age": self.robot.age()})
        self._hold(self.board.reason)
        while self.robot.age() > self.freshness.stale_after and self.state is State.RUNNING:
            self._fetch()  # a link that fell silent says so itself
            if self.state is State.RUNNING and time.monotonic() - began > self.freshness.limit:
                self.fault(
                    f"observations were stale for {time.monotonic() - began:.1f} s (limit {self.freshness.limit:g} s), "
                    f"the newest is {self.robot.age():.2f} s old (fresh is {self.freshness.stale_after:g} s): the "
                    "hardware server or a camera stopped, or this machine is too busy; look at it, then press Resume"
                )
                return True
            self.show()
            time.sleep(self.clock.period)
            self._drain("attempt")
            self._notice("attempt")
        self.clock.restart()
        if self.state is State.RUNNING:
            self.board.reason = ""
            self.say(f"observations were stale for {time.monotonic() - began:.2f} s; the arm was held", "warning")
        return True

    # ── what the operator asks ──────────────────────────────────────────────────────────────────────────────────────

    def _drain(self, phase: str) -> None:
        for intent in self.inbox.drain():
            self._ask(intent, phase)

    def _ask(self, intent: Intent, phase: str) -> None:
        """Refuse an intent with a reason, or obey it."""
        why = refusal(self.state, intent)
        self.board.refusal = why
        if why:
            self.say(why, "warning")
        else:
            self._obey(intent, phase)

    def _obey(self, intent: Intent, phase: str) -> None:
        """Do what an intent asks and take its transition."""
        self.recorder.event("intent", intent.value)
        match intent:
            case Intent.STOP:
                self._hold("STOP pressed by the operator", latch=True)
                return self._stopped(Intent.STOP, "STOP pressed by the operator")
            case Intent.RESUME if self.state in (State.HOMING, State.ADAPTING):
                self._answer_the_way_home()
            case Intent.RESUME if self.state is not State.PAUSED and not self._unlatch():
                return None
            case Intent.PAUSE:
                self._hold("paused by the operator")
                self.board.reason = "paused by the operator"
            case Intent.MARK_SUCCESS if self.state is State.ADAPTING:
                self.marked = Outcome(success=True, judged_by=Judge.OPERATOR, note="marked after the attempt")
                self._hold("marked a success by the operator")
            case Intent.MARK_SUCCESS | Intent.MARK_FAILURE:
                self._rule(success=intent is Intent.MARK_SUCCESS, note="marked by the operator")
            case Intent.SKIP_TRIAL:
                self.skipping = True
                self._rule(success=False, note="skipped by the operator")
                if phase == "homing":
                    self._hold("trial skipped by the operator")
            case Intent.QUIT:
                self._hold("the session was ended by the operator")
        self.happen(intent)
        return None

    def _rule(self, *, success: bool, note: str) -> None:
        self.override.rule(Outcome(success=success, judged_by=Judge.OPERATOR, note=note))

    def _stopped(self, event: Event, reason: str) -> None:
        self.no_lesson = True
        self._rule(success=False, note=reason)
        if self.state is not State.FAULT:
            self.board.reason = reason
        self.happen(event)
        self.say(reason, "warning")

    def _answer_the_way_home(self) -> None:
        """The operator has taken what the hand holds: it may open (tasks whose release is "ask")."""
        try:
            self.robot.request(Resume())
        except RobotError as error:
            self.board.refusal = str(error)
            self.say(str(error), "error")

    def _unlatch(self) -> bool:
        """Ask the hw server to leave its latch; what it answers is shown when it refuses."""
        deadline = time.monotonic() + 1.0
        try:
            self.robot.request(Resume())
            while self.robot.refresh().status.mode is RobotMode.LATCHED:
                if time.monotonic() > deadline:
                    raise RobotError("the hardware server stayed latched for 1 s after Resume; press Resume again")
                time.sleep(self.clock.period / 3)
        except RobotError as error:
            self.board.refusal = str(error)
            self.say(str(error), "error")
            return False
        return True

    def _hold(self, reason: str, latch: bool = False) -> None:
        """Ask for a hold; an hw server that cannot hear it holds by its own watchdog."""
        try:
            self.robot.request(Hold(reason=reason, latch=latch))
        except RobotError as error:
            log.warning("hold (%s): %s", reason, error)
