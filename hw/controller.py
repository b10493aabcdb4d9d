"""The arm's controller: what mode it is in, which target it follows, when it holds. No threads, no sockets, no clock.

    offer(target)    admit or refuse, at once; the acknowledgment waits in take_acks()
    request(…)       Home, Hold, Resume, Heartbeat
    stop(reason)     latch; the one method that any thread may call at any moment
    tick(measured)   once a servo period: the pose and gripper for the arm, always through hw/safety.py

    HOLD ──target──▶ TRACKING ──100 ms without one──▶ HOLD          any ──STOP, fault──▶ LATCHED ──Resume──▶ HOLD
    HOLD, TRACKING ──Guide──▶ GUIDED (led by hand) ──Guide off, no heartbeat──▶ HOLD
    HOLD, TRACKING ──Home──▶ HOMING ──home and settled──▶ HOLD      HOMING without heartbeats stands still

Motion after any hold starts from the measured pose, once the arm has come to rest. The same controller serves the twin
(120 Hz) and a real arm.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from far_app.config import TaskConfig
from far_app.errors import RobotError
from far_app.protocols import Guide, Heartbeat, Hold, Home, Reset, Resume
from far_app.types import Ack, Pose, RobotMode, RobotStatus, Target
from hw.homing import Homing, Phase
from hw.plant import Measured
from hw.rig import RigConfig
from hw.safety import Along, Brake, Follow, SafetyState, safety_filter, violation

log = logging.getLogger(__name__)

BREACH = 0.05
"""Metres outside the workspace box at which the measured arm counts as breaching it."""
AT_WALL = 0.002
"""Metres outside the box within which a measured pose is taken for the box's wall itself."""
STALE = 0.1
"""Age of the arm's own report, seconds, from which it is not led on."""
LOST = 1.0
"""The same, from which it is a fault."""
RESTED = 0.2
"""Seconds the command must have stood still before the arm's report is where the arm will stay."""
EPSILON = 1e-9


class ArmController:
    """Called by one thread at a time (stop excepted). Times in seconds on the clock of the targets; `stopwatch` (any
    clock) measures what the filter takes and nothing else: without one (simulated time) nobody does."""

    def __init__(
        self, rig: RigConfig, task: TaskConfig, servo_hz: int, measured: Measured,
        stopwatch: Callable[[], float] = lambda: math.nan,
    ) -> None:  # fmt: skip
        self.rig, self.task, self._stopwatch = rig, task, stopwatch
        self.period = 1.0 / servo_hz
        self.ramp = max(1, round(servo_hz / task.rate))
        self.holds = self.clips = 0
        self.scene_seed: int | None = None
        self._stop_reason = ""
        self._acks: list[Ack] = []
        self.mode, self.reason, self.fault = RobotMode.HOLD, "", False
        self.reset(measured, None)

    # ── what others ask ──

    def reset(self, measured: Measured, scene_seed: int | None) -> None:
        """The arm and the scene were put in place by other means. Refused while latched."""
        self.refuse_latched("Reset")
        self.measured = measured
        self.scene_seed = scene_seed
        self._grip = -1.0 if measured.gripper > 0.9 else 1.0 - 2.0 * measured.gripper  # as it is: it may hold something
        self._homing: Homing | None = None
        self._at_home = self._breached = self._silent = False
        self._last_fresh = -math.inf
        self._last_seq = -1
        self._anchor()
        self.mode, self.reason = RobotMode.HOLD, ""

    def offer(self, target: Target, now: float) -> Ack:
        """Admit a target or say why not; either way its acknowledgment is due."""
        if self.mode is RobotMode.LATCHED or self._stop_reason:
            return self._refuse(target, now, f"the arm is latched ({self.reason or self._stop_reason}); resume first")
        if self.mode is RobotMode.GUIDED:
            return self._refuse(target, now, "the arm is led by hand; end that first")
        if self.mode is RobotMode.HOMING:
            return self._refuse(target, now, "the arm is going home; targets are taken again when it is there")
        if self.measured.age > STALE:
            return self._refuse(target, now, f"the arm's last report is {1e3 * self.measured.age:.0f} ms old")
        state = self._departure() if self.mode is RobotMode.HOLD else self._state
        began = self._stopwatch()
        verdict = safety_filter(state, target, self.rig.safety, now)
        took = self._stopwatch() - began
        if verdict.refused:
            return self._refuse(target, now, verdict.refused)
        if self.mode is RobotMode.HOLD:
            self.mode, self.reason = RobotMode.TRACKING, ""
        self._state, self._last_fresh, self._last_seq = verdict.state, now, target.seq
        self._at_home, self._homing = False, None
        self._grip = float(np.clip(target.gripper, -1.0, 1.0))
        self.clips += verdict.clipped
        return self._acknowledge(target, now, verdict.pose, self._grip, clipped=verdict.clipped, took=took)

    def request(self, request: Home | Hold | Resume | Heartbeat | Reset | Guide, now: float) -> None:
        """Change the mode, or raise RobotError saying why not. (Reset is the plant's owner's affair.)"""
        if isinstance(request, Heartbeat):
            self._heartbeat(now)
        elif isinstance(request, Resume):
            self._resume(now)
        elif isinstance(request, Hold):
            if request.latch:
                self._latch(request.reason, fault=False)
            elif self.mode is not RobotMode.LATCHED:
                self._hold(request.reason)
                self._homing = None
        elif isinstance(request, Guide):
            self._guide(request, now)
        elif isinstance(request, Home):
            self.refuse_latched("Home")
            self._go_home(now)
        else:
            raise RobotError(f"{type(request).__name__} is not for the controller; ask the robot that owns the plant")

    def refuse_latched(self, what: str) -> None:
        """Raise RobotError while the arm is latched."""
        if self.mode is RobotMode.LATCHED or self._stop_reason:
            raise RobotError(f"{what} refused: the arm is latched ({self.reason or self._stop_reason}); resume first")

    def refuse_guiding(self, request: Guide) -> None:
        """Raise RobotError where nobody may lead the arm by hand now."""
        if request.on:
            self.refuse_latched("Guide")
            if self.mode is RobotMode.HOMING:
                raise RobotError("Guide refused: the arm is going home; it can be led by hand when it is there")

    def refuse_unlatching(self) -> None:
        """Raise RobotError while a STOP is under way."""
        if self._stop_reason:
            raise RobotError("Resume refused: a STOP is being carried out; look, then resume again")

    def stop(self, reason: str) -> None:
        """Latch. Any thread, any time: a plain assignment that the next servo tick acts on before all else."""
        self._stop_reason = reason or "STOP"

    def stand(self) -> None:
        """The arm was stopped by other means than its command and stands where it was last measured."""
        self._anchor()

    def fail(self, reason: str) -> None:
        """Latch by a fault that others noticed: a lost camera, a dead servo loop."""
        self._latch(reason, fault=True)

    def take_acks(self) -> tuple[Ack, ...]:
        """The acknowledgments since last asked."""
        acks, self._acks = self._acks, []
        return tuple(acks)

    def status(self) -> RobotStatus:
        stopping = bool(self._stop_reason)
        progress = self._homing.progress if self._homing is not None else float(self._at_home)
        return RobotStatus(
            mode=RobotMode.LATCHED if stopping else self.mode, reason=self._stop_reason or self.reason,
            fault=self.fault and not stopping, at_home=self._at_home, homing_progress=progress, holds=self.holds,
            clips=self.clips, scene_seed=self.scene_seed,
        )  # fmt: skip

    # ── the servo tick ──

    def tick(self, now: float, measured: Measured) -> tuple[Pose, float]:
        """The pose and gripper to command for the coming servo period."""
        self.measured = measured
        if self._stop_reason:
            reason, self._stop_reason = self._stop_reason, ""
            self._latch(reason, fault=False)
        self._watch_arm(measured)
        silent = now - self._last_fresh >= self.rig.watchdog - EPSILON
        stale = measured.age > STALE
        command: Follow | Along | Brake = Brake()
        if self.mode is RobotMode.TRACKING:
            if silent or stale:
                self.holds += 1
                self._hold(
                    f"no fresh target for {self.rig.watchdog * 1e3:.0f} ms" if silent
                    else f"the arm's last report is {measured.age * 1e3:.0f} ms old (limit {STALE * 1e3:.0f} ms)"
                )  # fmt: skip
            else:
                command = Follow()
        elif self.mode is RobotMode.HOMING:
            command = self._homing_command(measured, silent or stale)
        elif self.mode is RobotMode.GUIDED:
            self._anchor()
            if silent or stale:
                self.holds += 1
                self._hold("led by hand, and the app or the arm fell silent: it is held")
        if measured.stalled:
            self._start_anew()
        verdict = safety_filter(self._state, command, self.rig.safety, now)
        moving = verdict.state.velocity.any() or verdict.state.spin.any()
        self._still = 0 if moving else self._still + 1
        self._state = verdict.state
        return verdict.pose, self._grip

    def _homing_command(self, measured: Measured, silent: bool) -> Along | Brake:
        homing = self._homing
        assert homing is not None, "homing mode without a way home"
        if silent:
            if not self._silent:
                self.holds += 1
                homing.interrupt()
                old = measured.age > STALE
                what = "fresh report of the arm" if old else "heartbeat"
                self.reason = f"homing stands still: no {what} for {(STALE if old else self.rig.watchdog) * 1e3:.0f} ms"
            self._silent = True
            return Brake()
        if self._silent:
            self._silent = False
            self._state = self._departure()
        self.reason = homing.waiting
        wish = homing.step(measured, self._state.pose, self.period)
        self._grip = homing.gripper
        if homing.failed:
            self._latch(homing.failed, fault=True)
            return Brake()
        if homing.phase is Phase.DONE:
            self._homing, self._at_home = None, True
            self.mode, self.reason = RobotMode.HOLD, ""
        return wish

    def _watch_arm(self, measured: Measured) -> None:
        """Faults of the arm itself."""
        numbers = (*measured.eef.position, *measured.eef.quaternion, *measured.joints)
        if measured.error and not (self.mode is RobotMode.LATCHED and self.fault):
            self._latch(measured.error, fault=True)
        elif measured.age > LOST and self.mode is not RobotMode.LATCHED:
            self._latch(
                f"the arm has not reported its pose for {measured.age:.1f} s (limit {LOST:g} s): the link or the "
                "controller is gone; look at both, then press Resume", fault=True,
            )  # fmt: skip
        elif not all(map(math.isfinite, numbers)):
            self._latch("the arm reports a pose that is not a finite number; check the controller", fault=True)
            return
        outside = violation(measured.eef.position, self.rig.safety)
        if outside > BREACH and not self._breached:
            self._latch(
                f"the hand is {outside * 1e3:.0f} mm outside the workspace box (limit {BREACH * 1e3:.0f} mm); clear "
                "the way, then resume: only motion back toward the box is let through", fault=True,
            )  # fmt: skip
        self._breached = outside > BREACH

    # ── changes of mode ──

    def _at_rest(self) -> SafetyState:
        """Starting anew from the measured pose."""
        eef = self.measured.eef
        if 0.0 < violation(eef.position, self.rig.safety) < AT_WALL:
            eef = Pose(
                position=np.clip(eef.position, self.rig.safety.box_min, self.rig.safety.box_max),
                quaternion=eef.quaternion,
            )
        return SafetyState.at_rest(eef, self.period, self.ramp, self._last_seq)

    def _anchor(self) -> None:
        self._state = self._at_rest()
        self._still = 0

    def _departure(self) -> SafetyState:
        """What motion after a hold starts from: the measured pose, or, where that was reported before the arm had come
        to rest, what it is coming to rest at."""
        if self._still * self.period - self.measured.age < RESTED - EPSILON:
            return replace(self._state, last_seq=self._last_seq)
        return self._at_rest()

    def _start_anew(self) -> None:
        """The arm stands at the last command after a late tick: no speed is carried over, nothing is caught up."""
        self._state = replace(
            self._state, velocity=np.zeros(3), spin=np.zeros(3), reference=self._state.pose,
            ramp_left=max(self._state.ramp_left, self.ramp),
        )  # fmt: skip
        if self._homing is not None:
            self._homing.interrupt()

    def _hold(self, reason: str) -> None:
        self.mode, self.reason = RobotMode.HOLD, reason
        log.info("arm held: %s", reason)

    def _latch(self, reason: str, fault: bool) -> None:
        if self.mode is RobotMode.LATCHED and self.fault:
            return  # the first fault is the one to read
        self.mode, self.reason, self.fault = RobotMode.LATCHED, reason, fault
        self._homing = None
        log.warning("arm latched%s: %s", " by a fault" if fault else "", reason)

    def _resume(self, now: float) -> None:
        if self.mode is RobotMode.HOMING and self._homing is not None:
            self._homing.released()
            self._heartbeat(now)
            return
        if self.measured.error:
            raise RobotError(f"Resume refused: the arm still reports '{self.measured.error}'; clear it at the arm")
        self.refuse_unlatching()
        if self.mode is RobotMode.LATCHED:
            self._state = self._departure()
            self._hold("resumed by the operator")
            self.fault, self._at_home = False, False

    def _guide(self, request: Guide, now: float) -> None:
        self.refuse_guiding(request)
        if request.on:
            self.mode, self.reason, self._last_fresh = RobotMode.GUIDED, "led by hand", now
            self._grip = float(np.clip(request.gripper, -1.0, 1.0))
            self._at_home, self._homing = False, None
            self._anchor()
        elif self.mode is RobotMode.GUIDED:
            self._hold("no longer led by hand")

    def _go_home(self, now: float) -> None:
        homing = Homing(self.rig, self.task, self.measured, self._grip)
        if homing.failed:
            raise RobotError(f"Home refused: {homing.failed}")
        if self.mode is RobotMode.GUIDED:
            self._anchor()
        elif self.mode is RobotMode.HOLD:
            self._state = self._departure()
        self._homing, self._at_home, self._silent, self._last_seq = homing, False, False, -1
        self.mode, self.reason, self._last_fresh = RobotMode.HOMING, homing.waiting, now

    def _heartbeat(self, now: float) -> None:
        if self.mode in (RobotMode.HOMING, RobotMode.GUIDED):
            self._last_fresh = now

    def _refuse(self, target: Target, now: float, reason: str) -> Ack:
        return self._acknowledge(target, now, self._state.pose, self._grip, refused=reason)

    def _acknowledge(
        self, target: Target, now: float, pose: Pose, gripper: float, clipped: bool = False, refused: str = "",
        took: float = math.nan,
    ) -> Ack:  # fmt: skip
        ack = Ack(
            seq=target.seq, accepted=now, due=target.due, pose=pose, gripper=gripper, clipped=clipped, refused=refused,
            filter_seconds=took,
        )  # fmt: skip
        self._acks.append(ack)
        return ack
