"""A real xArm7 as a plant: the controller's servo mode at 100 Hz, its faults in words, its stop on a line of its own.

    measure    the newest report, and everything that is wrong with the arm or its link, once, in words
    servo      one target: finite, near the last one sent (2.5 mm), in servo mode; else nothing is sent
    halt       any thread: set_state(4) on the stop connection at once
    rearm      the operator pressed Resume: reconnect, clear errors, servo mode again, from where the arm stands

A fault found here stays until `rearm`: nothing is sent meanwhile, the controller holds the arm where it is.
"""

from __future__ import annotations

import logging
import math
import statistics
import threading
import time
from collections import deque

import numpy as np

from far_app.config import TaskConfig
from far_app.errors import RobotError
from far_app.types import Pose
from hw.plant import Measured
from hw.rig import RigConfig
from hw.safety import near, near_turn
from hw.xarm7.links import Links
from hw.xarm7.sdk import ABLE, HAS_ERROR, MANUAL_MODE, NOT_CONNECTED, OK, SERVO_MODE, TIMEOUT, error_text
from hw.xarm7.start import clear_errors, enter_manual_mode, enter_servo_mode
from hw.xarm7.telling import Told
from hw.xarm7.units import axis_angle

log = logging.getLogger(__name__)

SLOW_SILENCE = 2.0
"""Seconds without a slow report, which alone carries error codes, after which the arm is not used."""
UNANSWERED = 5
"""Servo calls in a row without an answer that make a fault."""
LATE = 3.0
"""Servo periods without a target after which the arm has come to rest: motion starts anew."""
SETTING_UP = 2.0
"""Seconds a call may take while nothing moves."""
ROUND_TRIPS = 50
"""Servo calls whose median round trip is compared with the limit."""


class XArmPlant:
    """hw.plant.Plant. The servo thread's, but for `halt`."""

    servo_hz = 100

    def __init__(self, rig: RigConfig, task: TaskConfig) -> None:
        """Connects and enters servo mode; an arm that has an error is left as it is, for the operator to resume.
        Raises RobotError where there is no controller."""
        self.rig, self.settings = rig, rig.xarm
        self.links = Links.open(rig)
        self._fault = ""
        self._halts = 0
        self._halted = self._armed = False
        self.guided = False
        self._guided_at = -math.inf
        self._sent: Pose | None = None
        self._sent_at = self._armed_at = -math.inf
        self._unanswered = 0
        self._round_trips = deque[float](maxlen=ROUND_TRIPS)
        self._lock = threading.Lock()
        """Orders `halt` against the end of `rearm`."""
        if self.links.telling.error:
            self._fault = error_text(self.links.telling.error)
        else:
            self._arm(self._halts)

    # ── the servo thread's ──

    def measure(self) -> Measured:
        told, links, now = self.links.telling.newest, self.links, time.monotonic()
        assert told is not None, "Links.open waited for the first report"
        if not self._fault and not self._halted:
            self._fault = self._trouble(told, now)
            if self._fault:
                self._armed = False
                log.error("the arm: %s", self._fault)
        return Measured(
            eef=told.pose, joints=told.joints, gripper=links.gripper.opening, error=self._fault,
            age=max(0.0, now - told.at),
            stalled=self._armed and now - self._sent_at > LATE / self.servo_hz,
        )  # fmt: skip

    def servo(self, pose: Pose, gripper: float) -> None:
        """Blocks for a round trip, at most settings.call_timeout."""
        if self.guided and not self._fault:
            self.links.gripper.wish(gripper)
            return
        if self._fault or self._halted or not self._armed or self._sent is None:
            return
        if not np.isfinite(pose.position).all() or not np.isfinite(pose.quaternion).all():
            self._fault = "a servo target was not a finite number; nothing was sent"
            return
        pose = self._near_the_last(pose)
        self.links.gripper.wish(gripper)
        began = time.monotonic()
        code = self.links.motion.set_servo_cartesian_aa(axis_angle(pose), is_radian=True)
        self._sent, self._sent_at = pose, began
        self._judge(code, time.monotonic() - began)

    def advance(self) -> None:
        """An arm moves by itself."""

    def reset(self, seed: int) -> None:
        """The scene is the operator's, the way home is Home's: nothing happens."""

    def snapshot(self) -> Told:
        told = self.links.telling.newest
        assert told is not None, "Links.open waited for the first report"
        return told

    def guide(self, on: bool) -> None:
        """The vendor's manual mode, and back to servo mode where the arm stands."""
        if self._fault or self._halted:
            self.guided = False
            if on:
                raise RobotError(
                    f"the arm cannot be led by hand: {self._fault or 'it was stopped'}; press Resume first"
                )
            return
        self._armed = False
        self.links.motion.set_timeout(SETTING_UP)
        halts = self._halts
        if on:
            enter_manual_mode(self.links.motion, self.links.telling, lambda: self._halts != halts)
            self._guided_at = time.monotonic()
        else:
            self._arm(halts)
        self.guided = on

    def rearm(self) -> bool:
        """On the operator's Resume only. Blocks for a second or so, ten when it must reconnect. Raises RobotError."""
        halts = self._halts
        if self.links.lost() or self._unanswered >= UNANSWERED:
            log.warning("connecting anew (lost: %s)", self.links.lost() or "no answers")
            self.links.close()
            self.links = Links.open(self.rig)
        self._armed, self._unanswered, self.guided = False, 0, False
        self.links.motion.set_timeout(SETTING_UP)
        clear_errors(self.links.motion, self.links.telling)
        self.links.gripper.enable_again()
        self._arm(halts)
        self._fault = ""
        return True

    def close(self) -> None:
        """Leave servo mode, let go of the connections."""
        if (self._armed or self.guided) and not self.links.lost():
            self.links.motion.set_mode(0)
            self.links.motion.set_state(0)
        self.links.close()

    # ── any thread's ──

    def halt(self) -> None:
        with self._lock:
            self._halts += 1
            self._halted = True
            self.links.stop.halt()

    # ── within ──

    def _arm(self, halts: int) -> None:
        """Into servo mode, unless a STOP came since `halts` were counted."""
        links = self.links
        self._round_trips.clear()
        links.gripper.forget()
        links.motion.set_timeout(SETTING_UP)
        here = enter_servo_mode(links.motion, links.telling, self.settings, lambda: self._halts != halts)
        links.motion.set_timeout(self.settings.call_timeout)
        with self._lock:
            if self._halts != halts:
                links.stop.halt()
                raise RobotError("STOP was pressed while the arm was made ready; look, then press Resume again")
            self._sent, self._sent_at = here, time.monotonic()
            self._armed_at = self._sent_at
            self._armed, self._halted = True, False
        log.info("servo mode at (%.3f, %.3f, %.3f) m", *here.position)

    def _near_the_last(self, pose: Pose) -> Pose:
        """The last line: no servo step beyond the rig's, whatever came before."""
        assert self._sent is not None
        return Pose(
            position=near(self._sent.position, pose.position, self.settings.servo_step),
            quaternion=near_turn(self._sent.quaternion, pose.quaternion, self.settings.servo_turn),
        )

    def _judge(self, code: int, seconds: float) -> None:
        """What a servo call's answer tells."""
        if code == TIMEOUT:
            self._unanswered += 1
            if self._unanswered >= UNANSWERED:
                self._fault = (
                    f"the controller answered none of the last {UNANSWERED} servo calls (each within "
                    f"{self.settings.call_timeout:g} s): the link is silent; check the cable and the controller's "
                    "power, then press Resume"
                )
            return
        self._unanswered = 0
        if code == NOT_CONNECTED:
            self._fault = self._link_lost("motion")
        elif code == HAS_ERROR:
            found = self.links.stop.error_code()
            self._fault = error_text(found) or error_text(self.links.telling.error)
        elif code == OK:
            self._round_trips.append(seconds)

    def _trouble(self, told: Told, now: float) -> str:
        """What is wrong with the arm or its link, in words; empty when nothing is."""
        links = self.links
        if lost := links.lost():
            return self._link_lost(lost)
        if links.telling.error:
            return error_text(links.telling.error)
        if self._armed and (told.mode != SERVO_MODE or told.state not in ABLE) and told.at > self._armed_at:
            code = links.stop.error_code()
            return error_text(code) or (
                f"the arm left servo mode (it reports mode {told.mode}, state {told.state}): paused, stopped or "
                "configured from elsewhere, such as UFACTORY Studio; end that, then press Resume"
            )
        if self.guided and told.mode != MANUAL_MODE and told.at > self._guided_at:
            return f"the arm left its manual mode (it reports mode {told.mode}): look at it, then press Resume"
        if now - links.telling.slow_at > SLOW_SILENCE:
            return (
                f"the controller has sent no report with error codes for {now - links.telling.slow_at:.1f} s (limit "
                f"{SLOW_SILENCE:g} s); check the network, then press Resume"
            )
        if len(self._round_trips) == ROUND_TRIPS:
            median = statistics.median(self._round_trips)
            if median > self.settings.latency_limit:
                return (
                    f"the controller answers servo calls in {1e3 * median:.0f} ms (median of {ROUND_TRIPS}; limit "
                    f"{1e3 * self.settings.latency_limit:.0f} ms): connect it by a cable of its own, then press Resume"
                )
        return links.gripper.error

    def _link_lost(self, which: str) -> str:
        return (
            f"the {which} connection to the controller at {self.settings.address} ended: it was restarted, or the "
            "cable or network failed; when the controller is up again, press Resume"
        )
