"""The safety filter: one pure function between every wish and the arm. Nothing reaches an arm without it.

    safety_filter(state, command, limits, now) → Verdict(state', pose, clipped, refused)

A Target (30 Hz) is admitted: refused when not finite, stale or out of order, else clipped to the step limits and the
box; it becomes the goal. Follow, Along and Brake (servo rate) let the commanded pose move for one period T under the
speed and acceleration limits: toward the goal, along a path, or to a stop. With reference r, its velocity ṙ and
d = r − p − ṙT, the velocity is ṙ + w, |w| ≤ min(|d|/T, √((aT/2)² + 2a|d|) − aT/2): the fastest approach that need not
overshoot; then |v| ≤ speed, |v − v₋| ≤ aT, and the point where full braking would end lies inside the box.

From outside the box only motion that lessens the violation, on no axis growing, passes. Called by hw/controller.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from far_app.motion import quat_from_rotvec, quat_multiply, rotation_between
from far_app.types import Pose, Target
from hw.rig import SafetyLimits

Vector = Float[np.ndarray, "3"]

REACH = 2.0
"""A goal lies at most this many target steps ahead of the commanded pose, however fast targets arrive."""
FUTURE = 0.1
"""Seconds by which a target may claim to be newer than now before its clock is called wrong."""
FAR_AWAY = 1e3
"""Metres; positions are cut to this before any arithmetic, so that nothing overflows."""
NOTICEABLE = 1e-7
"""Metres or radians by which a clipped target differs at least."""


@dataclass(frozen=True, kw_only=True)
class Follow:
    """One servo period on toward the goal, reached one ramp after the target came."""


@dataclass(frozen=True, kw_only=True)
class Along:
    """One servo period along a path: the pose to be at by its end."""

    pose: Pose


@dataclass(frozen=True, kw_only=True)
class Brake:
    """One servo period of slowing to a stop; the goal is forgotten."""


@dataclass(frozen=True, kw_only=True)
class SafetyState:
    """What the filter remembers between calls."""

    pose: Pose
    """Commanded at the end of the last servo period."""
    goal: Pose
    """The last admitted target."""
    reference: Pose
    """Where the ramp to the goal, or the path, has come to."""
    period: float
    """T, seconds a servo period."""
    ramp: int
    """Servo periods of the way from one target to the next."""
    ramp_left: int = 0
    velocity: Vector = field(default_factory=lambda: np.zeros(3))
    """Of the last servo period, m/s."""
    spin: Vector = field(default_factory=lambda: np.zeros(3))
    """Of the last servo period, rad/s, base frame."""
    last_seq: int = -1
    """Of the last admitted target."""

    @classmethod
    def at_rest(cls, pose: Pose, period: float, ramp: int, last_seq: int = -1) -> SafetyState:
        """Commanding this (measured) pose, not moving."""
        return cls(pose=pose, goal=pose, reference=pose, period=period, ramp=ramp, last_seq=last_seq)


@dataclass(frozen=True, kw_only=True)
class Verdict:
    state: SafetyState
    pose: Pose
    """A target as admitted, or what to send to the arm for this servo period."""
    clipped: bool = False
    """A target was changed by a limit."""
    refused: str = ""
    """Why a target was not admitted; the state is then unchanged."""


def safety_filter(
    state: SafetyState, command: Target | Follow | Along | Brake, limits: SafetyLimits, now: float
) -> Verdict:
    """The one door; see the module's docstring. `now` in seconds on the clock of the targets."""
    if isinstance(command, Target):
        refused = refusal(state, command, now)
        if refused:
            return Verdict(state=state, pose=state.goal, refused=refused)
        return _admit(state, command, limits)
    return _move(state, command, limits)


def refusal(state: SafetyState, target: Target, now: float) -> str:
    """Why a target may not be admitted; empty when it may."""
    numbers = (*target.pose.position, *target.pose.quaternion, target.gripper, target.created, target.expires)
    if len(numbers) != 10 or not all(map(math.isfinite, numbers)):
        return f"target {target.seq} holds a value that is not a finite number; check the policy's output"
    if abs(math.hypot(*target.pose.quaternion) - 1.0) > 0.01:
        return f"target {target.seq}'s quaternion has length {math.hypot(*target.pose.quaternion):.3g}, must be 1"
    if target.seq <= state.last_seq:
        return f"target {target.seq} came after target {state.last_seq}: out of order or sent twice"
    if now > target.expires:
        return f"target {target.seq} expired {1e3 * (now - target.expires):.0f} ms before it was read"
    if target.created > now + FUTURE:
        return f"target {target.seq} claims to be {1e3 * (target.created - now):.0f} ms from the future; check clocks"
    return ""


def _admit(state: SafetyState, target: Target, limits: SafetyLimits) -> Verdict:
    wanted = np.clip(target.pose.position, -FAR_AWAY, FAR_AWAY)
    turned = target.pose.quaternion / np.linalg.norm(target.pose.quaternion)
    ahead = math.dist(state.goal.position, state.pose.position)
    position = near(state.pose.position, wanted, max(ahead, REACH * limits.step_translation))
    position = near(state.goal.position, position, limits.step_translation)
    position = keep_goal_in_box(state.pose.position, position, limits)
    if position is state.pose.position:
        quaternion = state.pose.quaternion
    else:
        ahead = float(np.linalg.norm(rotation_between(state.pose.quaternion, state.goal.quaternion)))
        quaternion = turned if limits.upright is None else near_turn(np.array(limits.upright), turned, limits.turn)
        quaternion = near_turn(state.pose.quaternion, quaternion, max(ahead, REACH * limits.step_rotation))
        quaternion = near_turn(state.goal.quaternion, quaternion, limits.step_rotation)
    goal = Pose(position=position, quaternion=quaternion)
    clipped = (
        float(np.abs(position - wanted).max()) > NOTICEABLE
        or (quaternion is not turned and float(np.linalg.norm(rotation_between(turned, quaternion))) > NOTICEABLE)
        or abs(target.gripper) > 1.0
    )
    return Verdict(
        state=replace(state, goal=goal, ramp_left=state.ramp, last_seq=target.seq), pose=goal, clipped=clipped
    )


def near(anchor: Vector, wish: Vector, reach: float) -> Vector:
    """The wish, or the point `reach` toward it."""
    offset = wish - anchor
    distance = math.hypot(*offset)
    return wish if distance <= reach else anchor + offset * (reach / distance)


def near_turn(anchor: Float[np.ndarray, "4"], wish: Float[np.ndarray, "4"], reach: float) -> Float[np.ndarray, "4"]:
    """The orientation wished for, or the one `reach` radians toward it."""
    turn = rotation_between(anchor, wish)
    angle = math.hypot(*turn)
    return wish if angle <= reach else quat_multiply(quat_from_rotvec(turn * (reach / angle)), anchor)


def excess(position: Vector, limits: SafetyLimits) -> Vector:
    """How far beyond the workspace box on each axis, metres, signed; zeros inside."""
    return position - np.clip(position, limits.box_min, limits.box_max)


def violation(position: Vector, limits: SafetyLimits) -> float:
    """Distance to the workspace box, metres; 0 inside."""
    return math.hypot(*excess(position, limits))


def region(position: Vector, limits: SafetyLimits) -> tuple[Vector, Vector]:
    """The box, stretched to hold the present position when that lies outside."""
    return np.minimum(limits.box_min, position), np.maximum(limits.box_max, position)


def keep_goal_in_box(position: Vector, wish: Vector, limits: SafetyLimits) -> Vector:
    """The wish clamped to the box; from outside a wish that does not lessen the violation is answered with staying."""
    low, high = region(position, limits)
    clamped = np.clip(wish, low, high)
    outside = violation(position, limits)
    return clamped if outside == 0.0 or violation(clamped, limits) < outside else position


def _move(state: SafetyState, command: Follow | Along | Brake, limits: SafetyLimits) -> Verdict:
    period = state.period
    if isinstance(command, Brake):
        velocity = limit_change(np.zeros(3), state.velocity, limits.acceleration * period)
        spin = limit_change(np.zeros(3), state.spin, limits.rotation_acceleration * period)
        return _send(state, velocity, spin, limits, ramp_left=0, follow=None)
    reference, ramp_left = _reference(state, command)
    velocity = approach(
        reference.position - state.pose.position, (reference.position - state.reference.position) / period,
        limits.acceleration, period,
    )  # fmt: skip
    velocity = limit_change(limit_length(velocity, limits.speed), state.velocity, limits.acceleration * period)
    spin = approach(
        rotation_between(state.pose.quaternion, reference.quaternion),
        rotation_between(state.reference.quaternion, reference.quaternion) / period,
        limits.rotation_acceleration, period,
    )  # fmt: skip
    spin = limit_change(limit_length(spin, limits.rotation_speed), state.spin, limits.rotation_acceleration * period)
    return _send(state, velocity, spin, limits, ramp_left=ramp_left, follow=reference)


def _reference(state: SafetyState, command: Follow | Along) -> tuple[Pose, int]:
    """Where the motion should be at this period's end."""
    if isinstance(command, Along):
        return command.pose, 0
    if state.ramp_left <= 1:
        return state.goal, 0
    share = 1.0 / state.ramp_left
    turn = rotation_between(state.reference.quaternion, state.goal.quaternion)
    position = state.reference.position + share * (state.goal.position - state.reference.position)
    quaternion = quat_multiply(quat_from_rotvec(share * turn), state.reference.quaternion)
    return Pose(position=position, quaternion=quaternion), state.ramp_left - 1


def approach(offset: Vector, feed: Vector, acceleration: float, period: float) -> Vector:
    """ṙ + w: the velocity that closes the offset to the reference as fast as may be without overshooting it."""
    rest = offset - feed * period
    distance = math.hypot(*rest)
    if distance < 1e-12:
        return feed
    half = 0.5 * acceleration * period
    speed = min(distance / period, math.sqrt(half * half + 2.0 * acceleration * distance) - half)
    return feed + rest * (speed / distance)


def limit_length(vector: Vector, limit: float) -> Vector:
    """At most `limit` long, same direction."""
    length = math.hypot(*vector)
    return vector if length <= limit else vector * (limit / length)


def limit_change(wish: Vector, before: Vector, limit: float) -> Vector:
    """The wish, or the nearest vector no farther than `limit` from the one before."""
    change = wish - before
    length = math.hypot(*change)
    return wish if length <= limit else before + change * (limit / length)


def _send(
    state: SafetyState, velocity: Vector, spin: Vector, limits: SafetyLimits, ramp_left: int, follow: Pose | None
) -> Verdict:
    """Keep the box, integrate one period."""
    here = state.pose.position
    kept = keep_in_box(here, state.velocity, velocity, limits, state.period)
    position = np.clip(here + kept * state.period, *region(here, limits))  # against rounding only
    outside = violation(here, limits)
    if outside > 0.0 and violation(position, limits) >= outside:
        position, kept = here, np.zeros(3)  # the last of the braking, less than rounding
        spin = limit_change(np.zeros(3), state.spin, limits.rotation_acceleration * state.period)
    quaternion = state.pose.quaternion
    if spin.any():
        quaternion = quat_multiply(quat_from_rotvec(spin * state.period), quaternion)
        quaternion = quaternion / np.linalg.norm(quaternion)
    pose = Pose(position=position, quaternion=quaternion)
    moved = replace(
        state, pose=pose, velocity=kept, spin=spin, ramp_left=ramp_left, reference=follow or pose,
        goal=state.goal if follow is not None else pose,
    )  # fmt: skip
    return Verdict(state=moved, pose=pose)


def braking_point(position: Vector, velocity: Vector, acceleration: float, period: float) -> Vector:
    """Where the arm stands after one period at this velocity and full braking from then on."""
    speed, drop = math.hypot(*velocity), acceleration * period
    periods = math.floor(speed / drop)
    rest = (periods * speed - drop * periods * (periods + 1) / 2) / speed if periods else 0.0
    return position + velocity * (period * (1.0 + rest))


def keep_in_box(here: Vector, before: Vector, velocity: Vector, limits: SafetyLimits, period: float) -> Vector:
    """The velocity, or the most of it (mixed with full braking, which is always possible) that can still stop inside
    the box; from outside the violation must lessen all the way to the stop, else the arm brakes."""
    low, high = region(here, limits)
    outside = violation(here, limits) > 0.0

    def allowed(candidate: Vector) -> bool:
        stop = braking_point(here, candidate, limits.acceleration, period)
        if not bool(((stop >= low) & (stop <= high)).all()):
            return False
        return not outside or lessens(stop - here, stop, limits)

    if allowed(velocity):
        return velocity
    braking = limit_change(np.zeros(3), before, limits.acceleration * period)
    share, step = 0.0, 0.5
    for _ in range(10):
        if allowed(braking + (share + step) * (velocity - braking)):
            share += step
        step /= 2
    return braking + share * (velocity - braking)


def lessens(way: Vector, end: Vector, limits: SafetyLimits) -> bool:
    """A straight way out of a violation lessens it up to its end. The violation is convex along the way: it falls all
    along when it still falls at the end, by a share of the motion that is more than rounding."""
    beyond = excess(end, limits)
    length = math.hypot(*beyond)
    return length == 0.0 or not way.any() or float(way @ beyond) < -1e-3 * length * math.hypot(*way)
