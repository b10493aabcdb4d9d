"""Values that cross the program's borders: observations, targets, chunks, steps, attempts, trials.

Frozen and keyword-only; numpy only. Lengths are metres, angles radians, quaternions xyzw, poses in the arm's base
frame, times seconds on the machine's monotonic clock, unless a field says otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from jaxtyping import Float, UInt8

from far_app.device_input import DeviceInput

ACTION_DIM = 7
"""Three translations, three rotations (rotation vector, base frame), the gripper (−1 opens, +1 closes)."""
ARM_DIMS = 6
"""The arm's part of an action; the gripper is dimension 6."""
TRANSLATION_DIMS = 3
"""The part of it that moves the hand in x, y, z."""


@dataclass(frozen=True, kw_only=True)
class Pose:
    position: Float[np.ndarray, "3"]
    """Metres, base frame."""
    quaternion: Float[np.ndarray, "4"]
    """xyzw, unit length."""


class RobotMode(StrEnum):
    """What the hw server is doing with the arm."""

    HOLD = "hold"
    """Still; a fresh target (or a home request) is accepted and motion starts from the measured pose."""
    TRACKING = "tracking"
    """Following targets."""
    HOMING = "homing"
    """Opening, retreating and going to the start pose; targets are refused, heartbeats keep it alive."""
    GUIDED = "guided"
    """A person leads it by hand; targets are refused, heartbeats keep it so."""
    LATCHED = "latched"
    """Still after STOP or a fault; everything but Resume is refused."""


@dataclass(frozen=True, kw_only=True)
class RobotStatus:
    mode: RobotMode
    reason: str = ""
    """Why the arm is held or latched, in words for the operator."""
    fault: bool = False
    """The latch is a fault of the arm, a camera or the link (a STOP is a latch without a fault)."""
    at_home: bool = False
    """The arm stands at the start pose and the last home request is complete."""
    homing_progress: float = 0.0
    """0 to 1."""
    holds: int = 0
    """Watchdog holds since the server began."""
    clips: int = 0
    """Targets changed by the safety filter since the server began."""
    scene_seed: int | None = None
    """Seed of the last scene reset (twin only)."""


@dataclass(frozen=True, kw_only=True)
class Target:
    """An absolute pose for the arm, valid for a moment."""

    seq: int
    pose: Pose
    gripper: float
    """−1 opens, +1 closes."""
    created: float
    """Monotonic seconds."""
    expires: float
    """Monotonic seconds; a target read later than this is dropped."""
    due: float = float("nan")
    """The absolute deadline of the tick this target belongs to; lateness = accepted − due."""


@dataclass(frozen=True, kw_only=True)
class Ack:
    """The hw server's answer to a target: what was *sent* to the arm after the safety filter."""

    seq: int
    accepted: float
    """Monotonic seconds at acceptance in the hw server."""
    due: float
    pose: Pose
    gripper: float
    clipped: bool = False
    refused: str = ""
    """Why nothing was sent; empty when the target was taken."""
    filter_seconds: float = float("nan")
    """What the safety filter took in the hw server; NaN where nobody measures it (lockstep)."""


@dataclass(frozen=True, kw_only=True)
class Observation:
    """The newest the robot knows, at one moment."""

    seq: int
    stamp: float
    """Capture time of the newest image (or of the state, without cameras), monotonic seconds."""
    eef: Pose
    """End effector, base frame."""
    gripper: float
    """Opening of the fingers: 0 closed, 1 open."""
    joints: Float[np.ndarray, "J"]
    images: Mapping[str, UInt8[np.ndarray, "H W 3"]] = field(default_factory=dict)
    """Camera name to RGB at the policy's size."""
    status: RobotStatus
    acks: tuple[Ack, ...] = ()
    """Answers to targets that arrived since the observation before."""
    objects: Mapping[str, Pose] = field(default_factory=dict)
    """Poses of the twin's objects, base frame; empty on hardware."""
    success: bool | None = None
    """The twin's own check of the task at this moment; None on hardware."""
    reward: float = 0.0
    """The twin's shaped reward, in [0, 1]; 0 on hardware."""
    device: DeviceInput | None = None
    """An input device at the arm; None without one."""


@dataclass(frozen=True, kw_only=True)
class ActionChunk:
    """a_{t:t+H−1}, predicted from the observation of tick t."""

    tick: int
    """Step index within the attempt of the observation the chunk was computed from."""
    actions: Float[np.ndarray, "H A"]
    policy_version: str
    value: float = float("nan")
    """V(s_t)."""
    candidates: Float[np.ndarray, "N H A"] | None = None
    """Other chunks considered at this tick (methods that resample)."""


@dataclass(frozen=True, kw_only=True)
class Step:
    """One tick of an attempt."""

    tick: int
    seq: int
    """Sequence number of the tick's target."""
    stamp: float
    """Capture time of the observation the tick acted on."""
    deadline: float
    """Absolute deadline of the tick."""
    observation: Observation
    action: Float[np.ndarray, "A"]
    """â_t = g(chunks), before perturbation, in [−1, 1]."""
    perturbation: Float[np.ndarray, "A"]
    """δ_t; zeros on a first attempt."""
    commanded: Float[np.ndarray, "A"]
    """â_t + δ_t, clipped to [−1, 1]; its motion fades in over the first ticks after a person handed back."""
    sent: Float[np.ndarray, "A"]
    """ã_t: the action that equals what the safety filter let pass; NaN until acknowledged."""
    chunk_tick: int
    """Tick of the newest chunk that shaped the action; −1 when starved with no plan left."""
    starved: bool
    """No chunk reached this tick: the arm held."""
    policy_version: str
    value: float
    """V(s_t); NaN when not computed in time."""
    reward: float
    success: bool | None
    lateness: float = float("nan")
    """Seconds from the deadline to the target's acceptance in the hw server."""
    intervention: bool = False
    """A person moved the arm: `action` is theirs."""


TICK_STAGES = ("observe", "infer", "aggregate", "filter", "send", "record", "publish")
"""What a tick's time goes into, as TickTimes tells it."""


@dataclass(frozen=True, kw_only=True)
class TickTimes:
    """What one tick of the real-time loop spent on each stage, seconds. `infer` and `filter` run beside the loop's own
    thread; the others are its, one after the other, and may wait for the interpreter."""

    tick: int
    """The policy's tick; at reduced speed several of the loop's share one."""
    stamp: float
    """The tick's deadline, monotonic seconds."""
    observe: float
    """Newest observation fetched; the operator, faults and freshness attended to."""
    infer: float
    """Chunks that became ready during this tick, in the planner's thread; 0 when none did."""
    aggregate: float
    """Success judged, chunks taken over and averaged, perturbation, target."""
    filter: float
    """The safety filter on this tick's target, in the hw server; 0 when its acknowledgment came too late or never."""
    send: float
    """The target put on its way."""
    record: float
    """The last step handed to the page's board and to the recorder's thread."""
    publish: float
    """The snapshot for the page, where one was due."""


class Judge(StrEnum):
    """Who decided an outcome."""

    TWIN = "twin"
    HORIZON = "horizon"
    DETECTOR = "detector"
    OPERATOR = "operator"
    FAULT = "fault"


@dataclass(frozen=True, kw_only=True)
class Outcome:
    success: bool
    judged_by: Judge
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class FlagCorrection:
    """The operator's word on one chunk: it is to blame, or it is not, whatever ΔV says."""

    tick: int
    """Tick at which the chunk begins."""
    flagged: bool
    by: str = ""
    """Who said so."""
    wall: str = ""
    """When, ISO 8601 with the offset to UTC."""


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """One execution of the policy, up to the task's horizon."""

    index: int
    """1 for the first attempt of the trial."""
    scene_seed: int
    steps: tuple[Step, ...]
    final: Observation
    """The observation after the last step (s_T)."""
    outcome: Outcome
    policy_version: str
    corrections: tuple[FlagCorrection, ...] = ()
    """The operator's words on its chunks, oldest first; the last on a tick counts."""


@dataclass(frozen=True, kw_only=True)
class Contrast:
    """What one flagged chunk was compared with: its positives, best Q first."""

    tick: int
    negative_q: float
    """Q(s_t, a⁻) of the chunk that was sent."""
    positives: Float[np.ndarray, "K H A"]
    """Fewer than K, or none, where no more candidates passed the filter."""
    q: Float[np.ndarray, "K"]
    """Q(s_t, a⁺), the smaller of the twins."""
    distance: Float[np.ndarray, "K"]
    """d(a⁺, a⁻), action units."""


@dataclass(frozen=True, kw_only=True)
class AdaptationStep:
    """Progress of one FCPA gradient step."""

    step: int
    steps: int
    loss: float
    winner_error: float
    """l⁺ on fixed draws."""
    loser_error: float
    """l⁻ on fixed draws."""


@dataclass(frozen=True, kw_only=True)
class Adaptation:
    """What one failure taught: flagged chunks, pairs, losses, and the policy version that came of it."""

    status: str
    """"adapted", "empty" (no pairs), "stopped" (guard), "withdrawn" (hedge), "cancelled", "failed", "timeout" or
    "none"."""
    base_version: str
    version: str
    """Policy version after the adaptation; equals base_version when nothing changed."""
    values: Float[np.ndarray, "T+1"]
    value_changes: Float[np.ndarray, "T+1-H"]
    threshold: float
    flagged: tuple[int, ...]
    """Ticks of the flagged chunks."""
    pairs: int = 0
    empty_states: int = 0
    """Flagged states whose filtered set was empty under [d_min, d_max] (before the fallback)."""
    history: tuple[AdaptationStep, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Wall-clock seconds by stage."""
    note: str = ""
    contrasts: tuple[Contrast, ...] = ()
    """The flagged chunks' positives; empty in recordings made before they were kept, and for objectives without."""
    corrections: tuple[FlagCorrection, ...] = ()
    """The operator's words that had come in time for `flagged`."""


@dataclass(frozen=True, kw_only=True)
class AdaptedWeights:
    """The weights an adaptation made, for the recording."""

    version: str
    parent: str
    """The version it was made from."""
    base: str
    """Fingerprint of the base policy: encoder and normaliser are its own."""
    tensors: Mapping[str, np.ndarray]
    """The denoiser's, by name; never written to again."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """All attempts on one scene."""

    scene_seed: int
    attempts: tuple[Attempt, ...]
    adaptations: tuple[Adaptation, ...]
    rescues: int = 0
    """How often the arm had to be freed by hand (counted in lockstep)."""

    @property
    def success(self) -> bool:
        return bool(self.attempts) and self.attempts[-1].outcome.success
