"""What the operator asks for, at any time: each intent is refused with a reason, or obeyed and its transition taken."""

from __future__ import annotations

import time

from far_app.errors import RobotError
from far_app.lineage import VersionWish
from far_app.marks import MarkAttempt
from far_app.protocols import Resume
from far_app.session.inbox import IntentInbox
from far_app.session.marking import Marking
from far_app.session.standing import Standing
from far_app.session.steering import Helper
from far_app.session.versions import VersionKeeper
from far_app.session_states import Intent, State
from far_app.take_over import Source
from far_app.types import Judge, Outcome, RobotMode


class Operator:
    """The intents of an inbox, acted on."""

    def __init__(
        self,
        inbox: IntentInbox,
        standing: Standing,
        helper: Helper,
        marking: Marking,
        versions: VersionKeeper,
        period: float,
    ) -> None:
        self.inbox, self.standing, self.helper, self.marking = inbox, standing, helper, marking
        self.versions = versions
        self.board, self.robot, self.recorder = standing.board, standing.robot, standing.recorder
        self._period = period
        """Of the loop, seconds."""

    def attend(self, phase: str) -> None:
        """Do what was asked since the last call. `phase`: of the trial, far_app/trial.py's or "between"."""
        for intent in self.inbox.drain():
            self.ask(intent, phase)
        pressed = self.helper.pressed()
        if pressed is not None:
            self.ask(pressed, phase, Source.DEVICE)
        self.standing.phase = phase
        self.listen()

    def listen(self) -> None:
        """What is no intent: presses that move the arm, words on attempts and policy versions."""
        self.helper.nudge()
        for mark in self.inbox.take(MarkAttempt):
            self.marking.hear(mark)
        for wish in self.inbox.take(VersionWish):
            self.versions.hear(wish)
        self.board.steering, self.board.versions = self.helper.told(), self.versions.told()

    def ask(self, intent: Intent, phase: str, source: Source = Source.PAGE) -> None:
        """Refuse an intent with a reason, or obey it."""
        self.standing.phase = phase
        why = self.standing.refusal(intent)
        self.board.refusal = why
        if why:
            self.standing.say(why, "warning")
        else:
            self._obey(intent, phase, source)

    def _obey(self, intent: Intent, phase: str, source: Source) -> None:
        """Do what an intent asks and take its transition."""
        self.recorder.event("intent", intent.value)
        match intent:
            case Intent.STOP:
                self.standing.hold("STOP pressed by the operator", latch=True)
                return self.standing.stopped(Intent.STOP, "STOP pressed by the operator")
            case Intent.RESUME if self.standing.state in (State.HOMING, State.ADAPTING):
                self._answer_the_way_home()
            case Intent.RESUME if self.standing.state is not State.PAUSED and not self._unlatch():
                return None
            case Intent.PAUSE:
                self.standing.hold("paused by the operator")
                self.board.reason = "paused by the operator"
            case Intent.MARK_SUCCESS if self.standing.state is State.ADAPTING:
                self.standing.marked = Outcome(success=True, judged_by=Judge.OPERATOR, note="marked after the attempt")
                self.standing.hold("marked a success by the operator")
            case Intent.MARK_SUCCESS | Intent.MARK_FAILURE:
                self.standing.rule(success=intent is Intent.MARK_SUCCESS, note="marked by the operator")
            case Intent.SKIP_TRIAL:
                self.standing.skipping = True
                self.standing.rule(success=False, note="skipped by the operator")
                if phase == "homing":
                    self.standing.hold("trial skipped by the operator")
            case Intent.TAKE_OVER:
                self.helper.take(source)
            case Intent.HAND_BACK:
                self.helper.hand_back()
            case Intent.QUIT:
                self.standing.hold("the session was ended by the operator")
        self.standing.happen(intent)
        return None

    def _answer_the_way_home(self) -> None:
        """The operator has taken what the hand holds: it may open (tasks whose release is "ask")."""
        try:
            self.robot.request(Resume())
        except RobotError as error:
            self.board.refusal = str(error)
            self.standing.say(str(error), "error")

    def _unlatch(self) -> bool:
        """Ask the hw server to leave its latch; what it answers is shown when it refuses."""
        deadline = time.monotonic() + 1.0
        try:
            self.robot.request(Resume())
            while self.robot.refresh().status.mode is RobotMode.LATCHED:
                if time.monotonic() > deadline:
                    raise RobotError("the hardware server stayed latched for 1 s after Resume; press Resume again")
                time.sleep(self._period / 3)
        except RobotError as error:
            self.board.refusal = str(error)
            self.standing.say(str(error), "error")
            return False
        return True
