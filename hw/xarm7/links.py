"""The connections to one controller: servo calls, feedback and gripper, STOP; opened and closed together."""

from __future__ import annotations

import time
from dataclasses import dataclass

from xarm.wrapper import XArmAPI

from far_app.errors import RobotError
from hw.rig import RigConfig
from hw.xarm7.gripper import Gripper
from hw.xarm7.sdk import Report, connect
from hw.xarm7.start import PATIENCE
from hw.xarm7.stop import StopLine
from hw.xarm7.telling import Telling


@dataclass(frozen=True, kw_only=True)
class Links:
    """The connections of one stretch of time, and what rides on them."""

    motion: XArmAPI
    feedback: XArmAPI
    stop: StopLine
    telling: Telling
    gripper: Gripper

    @classmethod
    def open(cls, rig: RigConfig) -> Links:
        """Three connections. Raises RobotError."""
        settings = rig.xarm
        opened: list[XArmAPI] = []
        try:
            kinds: tuple[tuple[Report, float], ...] = (("rich", settings.call_timeout), ("real", 0.5), ("none", 0.2))
            for report, timeout in kinds:
                opened.append(connect(settings, report, timeout))
        except RobotError:
            for api in opened:
                api.disconnect()
            raise
        motion, feedback, stop = opened
        links = cls(
            motion=motion, feedback=feedback, stop=StopLine(stop, (motion, feedback)),
            telling=Telling(motion, feedback), gripper=Gripper(feedback, settings.gripper),
        )  # fmt: skip
        now = time.monotonic()
        if links.telling.wait_fast(now, PATIENCE) is None or not links.telling.wait_slow(now, PATIENCE):
            links.close()
            raise RobotError(
                f"the controller at {settings.address} answers but sends no reports (ports 30002, 30003); is a "
                "firewall between, or are there other programs connected that use them up?"
            )
        links.gripper.start()
        return links

    def lost(self) -> str:
        """Which connection has ended; empty when none."""
        named = {"motion": self.motion, "feedback": self.feedback, "STOP": self.stop.api}
        return ", ".join(name for name, api in named.items() if not api.connected)

    def close(self) -> None:
        self.gripper.close()
        self.stop.close()
        for api in (self.motion, self.feedback, self.stop.api):
            api.disconnect()
