"""What may interrupt a trial at any tick: the operator, a latch, a fault, stale observations, a policy gone wrong.

Asked once a tick (`attend`); `rest` waits, with the arm held, until the operator lets things go on. What it notices
changes where the session stands (standing.py); what the operator asks is done by operator.py.
"""

from __future__ import annotations

import math
import time

from far_app.errors import FarError, RobotError
from far_app.protocols import Heartbeat, Home
from far_app.session.clock import TickClock
from far_app.session.course import Gate
from far_app.session.operator import Operator
from far_app.session.planners import ThreadedPlanner
from far_app.session.settings import Freshness
from far_app.session.standing import IN_ATTEMPT, MOVING, RESTING, Standing
from far_app.session.steering import Helper
from far_app.session_states import Happening, Intent, State
from far_app.types import RobotMode, RobotStatus


class SessionFault(FarError):
    """The session met a fault and nobody is there to clear it."""


class TrialAbandoned(Exception):
    """Unwinds a trial that ends outside its own course: skipped, marked while adapting, the session ended."""


class Supervision:
    def __init__(
        self,
        *,
        standing: Standing,
        operator: Operator,
        helper: Helper,
        planner: ThreadedPlanner,
        clock: TickClock,
        freshness: Freshness,
        headless: bool,
        page_silence: float = math.inf,
    ) -> None:
        self.standing, self.operator, self.planner, self.clock = standing, operator, planner, clock
        self.helper = helper
        self.board, self.robot, self.recorder = standing.board, standing.robot, standing.recorder
        self.freshness, self.headless = freshness, headless
        self.page_silence = page_silence
        """Seconds without a page that someone looks at, after which the arm is held."""

    def attend(self, phase: str) -> bool:
        """Look at what happened since the last tick; True when the arm was held and motion must start afresh.

        In an attempt, a stop or a fault is ruled on and the trial ends the attempt by itself; on the way home it is
        waited out here. Raises TrialAbandoned where the trial must not go on."""
        self._fetch()
        self.operator.attend(phase)
        self._notice(phase)
        held = phase == "attempt" and self.standing.state in IN_ATTEMPT and self._wait_while_stale()
        held = self._wait_while_silent() or held
        if self.standing.state is State.PAUSED or (phase == "homing" and self.standing.state in RESTING):
            interrupted = State.ADAPTING if self.board.adapting else State.HOMING
            self.rest(phase)
            held = True
            if self.standing.state is State.READY and phase == "homing":
                self.robot.request(Home())
                self.standing.happen(
                    Happening.GO_ON_ADAPTING if interrupted is State.ADAPTING else Happening.GO_ON_HOMING
                )
            elif self.standing.state is State.READY:
                self.standing.happen(Happening.GO_ON_ATTEMPT)
        if self.standing.state is State.FINISHED or (phase == "homing" and self.standing.state is State.TRIAL_DONE):
            raise TrialAbandoned
        return held

    def rest(self, phase: str = "") -> None:
        """Wait, the arm held, while the state is one of rest. Raises SessionFault on a fault nobody can clear."""
        while self.standing.state in RESTING:
            if self.headless and self.standing.state is State.FAULT:
                raise SessionFault(self.board.reason)
            if phase == "attempt" and self.standing.state is not State.PAUSED:
                return  # ruled on: the trial ends the attempt
            self.standing.show()
            time.sleep(self.clock.period)
            self._fetch()
            self.operator.attend(phase)
            self._notice(phase)
        self.clock.restart()

    def attend_between(self) -> None:
        """Look at the arm while nothing runs: a latch, a fault, a recording that stopped."""
        self._fetch()
        self._notice("between")

    def await_scene(self, gate: Gate | None = None) -> bool:
        """Hold until the operator has rebuilt the scene, which a plan's `gate` looks at, and says that the workspace is
        clear; False when the session ended instead."""
        self.standing.hold("waiting for the scene")
        while self.standing.state is not State.FINISHED:
            if self.standing.state in (State.READY, State.TRIAL_DONE):
                self.standing.happen(Happening.NEED_SCENE)
            seen = self.robot.newest
            self.board.scene = gate.look(seen) if gate is not None and seen is not None else None
            self.standing.show()
            time.sleep(self.clock.period)
            self._fetch()
            for intent in self.operator.inbox.drain():
                asked = self.standing.state
                awaited = intent is Intent.SCENE_READY and asked is State.AWAITING_SCENE
                if awaited and gate is not None and seen is not None and (why := gate.refusal(seen)):
                    self.board.refusal = why
                    self.standing.say(why, "warning")
                    continue
                self.operator.ask(intent, "between")
                if asked is State.AWAITING_SCENE and self.standing.state is State.READY:
                    self.board.scene = None
                    return True
            self.operator.listen()
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
            self.standing.show()
            time.sleep(self.clock.period)
            self.robot.request(Heartbeat())
            try:
                held = self.attend("homing")
            finally:
                self.board.countdown = 0.0
            if held or (self.robot.newest is not None and not self.robot.newest.status.at_home):
                begins = time.monotonic() + seconds
        self.board.reason = ""

    # ── what is noticed ─────────────────────────────────────────────────────────────────────────────────────────────

    def _fetch(self) -> None:
        try:
            self.robot.refresh()
        except RobotError as error:
            self.standing.fault(str(error))

    def _notice(self, phase: str) -> None:
        """A latch or a fault of the hw server, a failure of the policy, a recording that stopped (it ends the session:
        attempts that nobody keeps are not worth the risk)."""
        status = self.robot.newest.status if self.robot.newest is not None else RobotStatus(mode=RobotMode.HOLD)
        latched = status.mode is RobotMode.LATCHED
        if latched and status.fault and self.standing.state is not State.FAULT:
            self.standing.fault(status.reason or "the arm reports a fault", lesson=True)  # the policy's own doing
        elif latched and self.standing.state not in (State.STOPPED, State.FAULT, State.FINISHED):
            self.standing.stopped(Happening.LATCH, status.reason or "STOP")
        if (
            phase == "homing"
            and self.standing.state in (State.HOMING, State.ADAPTING)
            and status.mode is RobotMode.HOMING
        ):
            self.board.reason = status.reason  # what the way home waits for
        if phase == "attempt" and self.planner.failure is not None:
            self.standing.fault(str(self.planner.failure))
        unseen = time.monotonic() - self.operator.inbox.looked_at
        if self.standing.state in MOVING and unseen > self.page_silence:
            self.standing.hold("nobody has the page open")
            self.standing.happen(Intent.PAUSE)
            self.board.reason = (
                f"nobody has had the page open for {unseen:.1f} s (limit {self.page_silence:g} s): the arm is held; "
                "look at it, then press Resume"
            )
            self.standing.say(self.board.reason, "warning")
        if self.recorder.error is not None:
            self.standing.hold(str(self.recorder.error))
            raise self.recorder.error

    def _wait_while_stale(self) -> bool:
        """Hold while observations are stale; True when they came back in time, else it is a fault."""
        if self.robot.age() <= self.freshness.stale_after:
            return False
        began = time.monotonic()
        self.robot.statistics.stale_holds += 1
        self.board.reason = "observations are stale; the arm is held"
        self.recorder.event("stale", self.board.reason, {"age": self.robot.age()})
        self.standing.hold(self.board.reason)
        while self.robot.age() > self.freshness.stale_after and self.standing.state in IN_ATTEMPT:
            self._fetch()  # a link that fell silent says so itself
            if self.standing.state in IN_ATTEMPT and time.monotonic() - began > self.freshness.limit:
                self.standing.fault(
                    f"observations were stale for {time.monotonic() - began:.1f} s (limit {self.freshness.limit:g} s), "
                    f"the newest is {self.robot.age():.2f} s old (fresh is {self.freshness.stale_after:g} s): the "
                    "hardware server or a camera stopped, or this machine is too busy; look at it, then press Resume"
                )
                return True
            self.standing.show()
            time.sleep(self.clock.period)
            self.operator.attend("attempt")
            self._notice("attempt")
        self.clock.restart()
        if self.standing.state in IN_ATTEMPT:
            self.board.reason = ""
            self.standing.say(
                f"observations were stale for {time.monotonic() - began:.2f} s; the arm was held", "warning"
            )
        return True

    def _wait_while_silent(self) -> bool:
        """Hold while the source of a person's motion is silent; True when the arm was held. It goes on when the source
        is heard again; until then the operator may do all else."""
        silence = self.helper.silence()
        if not silence:
            return False
        self.standing.hold(silence)
        self.standing.say(f"{silence}; the arm is held", "warning")
        self.recorder.event("take_over_silent", silence)
        while silence := self.helper.silence():
            self.board.reason = f"{silence}: the arm is held until it is heard again, or you hand back"
            self.standing.show()
            time.sleep(self.clock.period)
            self._fetch()
            self.operator.attend("attempt")
            self._notice("attempt")
        if self.standing.state in IN_ATTEMPT:
            self.board.reason = ""
        return True
