"""Where a session stands: its state and why, what the operator is told of it, and an arm that is held.

Supervision (what interrupts), the operator's intents and the session's own course all change it, through here only:
every change is a transition of far_app/session_states.py, logged and recorded.
"""

from __future__ import annotations

import logging
import time

from far_app.detectors import OperatorOverride
from far_app.errors import RobotError
from far_app.protocols import Hold
from far_app.session.board import Board
from far_app.session.publisher import RATE, TelemetryPublisher
from far_app.session.recorder import Recorder
from far_app.session.watched import WatchedRobot
from far_app.session_states import Event, Happening, Intent, State, allowed, refusal, step
from far_app.types import Judge, Outcome, RobotMode

log = logging.getLogger(__name__)

RESTING = (State.PAUSED, State.STOPPED, State.FAULT)
IN_ATTEMPT = (State.RUNNING, State.TAKEN_OVER)
MOVING = (State.HOMING, *IN_ATTEMPT, State.ADAPTING)
"""States in which the arm may move."""


class Standing:
    def __init__(
        self,
        *,
        robot: WatchedRobot,
        override: OperatorOverride,
        recorder: Recorder,
        board: Board,
        publisher: TelemetryPublisher | None,
    ) -> None:
        self.robot, self.recorder, self.board = robot, recorder, board
        self._override, self._publisher = override, publisher
        self.state = State.READY
        self.phase = ""
        """Of the trial: far_app/trial.py's, or "between"."""
        self.withheld: dict[Intent, str] = {}
        """Why the session itself refuses an intent that its state would let pass."""
        self.skipping = False
        """The operator skips this trial: it ends with its running attempt."""
        self.no_lesson = False
        """The attempt was ended by a stop or by trouble of ours: nothing to learn from."""
        self.marked: Outcome | None = None
        """The operator's word on an attempt that had already ended."""
        self._shown = 0.0

    def trial_begins(self) -> None:
        self.happen(Happening.BEGIN_TRIAL)
        self.skipping, self.marked = False, None

    def refusal(self, intent: Intent) -> str:
        """Why an intent does not apply now; empty when it does."""
        why = refusal(self.state, intent)
        if not why and self.withheld.get(intent):
            return f"'{intent}' is refused: {self.withheld[intent]}"
        if not why and intent is Intent.RESUME and self.state in (State.HOMING, State.ADAPTING) and not self._asked():
            return f"'{intent}' is refused: the arm goes home by itself"
        if why or intent is not Intent.TAKE_OVER:
            return why
        if self.phase not in ("attempt", "judging"):
            return f"'{intent}' is refused while the arm goes home: only an attempt can be taken over"
        return ""

    def _asked(self) -> bool:
        """The way home waits for the operator to take what the hand holds."""
        newest = self.robot.newest
        return newest is not None and newest.status.mode is RobotMode.HOMING and bool(newest.status.reason)

    def allowed(self) -> tuple[Intent, ...]:
        """The intents that apply now."""
        return tuple(intent for intent in allowed(self.state) if not self.refusal(intent))

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
        if self._publisher is not None and now - self._shown > 0.9 / RATE:
            self._shown = now
            self._publisher.show(self.board.telemetry(self.state, self.robot.newest, self.allowed()))

    def rule(self, *, success: bool, note: str) -> None:
        """The operator's word on the attempt under way."""
        self._override.rule(Outcome(success=success, judged_by=Judge.OPERATOR, note=note))

    def stopped(self, event: Event, reason: str) -> None:
        """Somebody pressed STOP: the attempt ends, and only the operator leads on."""
        self.no_lesson = True
        self.rule(success=False, note=reason)
        if self.state is not State.FAULT:
            self.board.reason = reason
        self.happen(event)
        self.say(reason, "warning")

    def fault(self, reason: str, lesson: bool = False) -> None:
        """Hold the arm, end the attempt as a failure (one to learn from or not), explain; only the operator clears
        it."""
        if self.state in (State.FAULT, State.FINISHED):
            return
        self.no_lesson = self.no_lesson or not lesson
        self._override.rule(Outcome(success=False, judged_by=Judge.FAULT, note=reason))
        self.board.reason = reason
        self.happen(Happening.FAULT)
        self.say(reason, "error")
        self.hold(reason)

    def hold(self, reason: str, latch: bool = False) -> None:
        """Ask for a hold; an hw server that cannot hear it holds by its own watchdog."""
        try:
            self.robot.request(Hold(reason=reason, latch=latch))
        except RobotError as error:
            log.warning("hold (%s): %s", reason, error)
