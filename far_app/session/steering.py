"""A person has the arm for a while: whose motion it is, whether its source is still there, what the page is told.

The state of the session (taken over or not) is standing.py's; this holds the hand itself. The trial asks it once a tick
(far_app.protocols.Person).
"""

from __future__ import annotations

import time

import numpy as np

from far_app.device_input import DeviceInput
from far_app.motion import ActionScale
from far_app.session.inbox import IntentInbox
from far_app.session.standing import Standing
from far_app.session_states import Intent, State
from far_app.take_over import Hand, Nudge, Source, Steering
from far_app.types import Observation


class Helper:
    """far_app.protocols.Person."""

    def __init__(self, standing: Standing, inbox: IntentInbox, scale: ActionScale) -> None:
        self.standing, self.inbox = standing, inbox
        self.hand = Hand(scale)
        self.ticks = 0
        """In which a person moved the arm, of this attempt."""
        self._presses: int | None = None
        """Of the device's take-over button, as last seen; None before the first look."""

    @property
    def steers(self) -> bool:
        return self.standing.state is State.TAKEN_OVER

    def action(self, observation: Observation) -> np.ndarray | None:
        if not self.steers:
            return None
        self.ticks += 1
        return self.hand.action(observation.device)

    def attempt_begins(self) -> None:
        self.ticks = 0
        self.inbox.take(Nudge)

    def take(self, source: Source) -> None:
        """The person has the arm from the coming tick on; the hand keeps what it holds."""
        self.hand.take(self.standing.robot.gripper, source)
        self._tell("taken_over", f"a person has the arm ({source})")

    def hand_back(self) -> None:
        self.hand.let_go()
        self._tell("handed_back", "the policy has the arm again")

    def nudge(self) -> None:
        """Carry out, or refuse, the presses that came since the last call."""
        for nudge in self.inbox.take(Nudge):
            why = self.hand.nudge(nudge.move) if self.steers else "the policy has the arm: take over first"
            self.standing.board.refusal = f"'{nudge.move}' is refused: {why}" if why else ""

    def pressed(self) -> Intent | None:
        """What a press of the device's own button asks for, if it was pressed since the last call."""
        device = self._device
        if device is None:
            return None
        before, self._presses = self._presses, device.presses
        if before is None or device.presses <= before:
            return None
        return Intent.HAND_BACK if self.steers else Intent.TAKE_OVER

    def silence(self) -> str:
        """Why the arm must be held though a person has it; "" when all is well, or nobody has it."""
        if not self.steers:
            return ""
        return self.hand.silence(self._device, time.monotonic() - self.inbox.looked_at)

    def told(self) -> Steering:
        """For the page."""
        device = self._device
        return Steering(
            source=self.hand.source or "" if self.steers else "", silent=self.silence(),
            unavailable=self.standing.withheld.get(Intent.TAKE_OVER, ""), device=device.name if device else "",
            trouble=device.trouble if device else "", ticks=self.ticks,
        )  # fmt: skip

    @property
    def _device(self) -> DeviceInput | None:
        newest = self.standing.robot.newest
        return newest.device if newest is not None else None

    def _tell(self, event: str, text: str) -> None:
        self.standing.recorder.event(event, text, {"source": self.hand.source or "", "ticks": self.ticks})
        self.standing.say(text)
