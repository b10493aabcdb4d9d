"""What the app and the hw server tell the operator page, and what it may answer. Latest wins; drops are counted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from far_app.lineage import Versions
from far_app.marks import Judged
from far_app.session_states import Intent, State
from far_app.take_over import Steering
from far_app.trial_plan.shown import PlanShown, SceneShown
from far_app.types import TICK_STAGES, AdaptationStep, Pose, RobotStatus
from far_app.wire import register

HIDDEN = "hidden"
"""Telemetry.adaptation_status where a blinded plan must not tell whether the method learns."""


@register
@dataclass(frozen=True, kw_only=True)
class LoopHealth:
    """How well the 30 Hz loop keeps time (the current session)."""

    hz: float = 0.0
    """Ticks a second over the last two seconds."""
    ticks: int = 0
    late_p50_ms: float = 0.0
    late_p99_ms: float = 0.0
    late_max_ms: float = 0.0
    late_ticks: int = 0
    """Ticks accepted more than 5 ms late."""
    overruns: int = 0
    """Ticks accepted more than 33 ms late."""
    starved: int = 0
    """Ticks with no plan left."""
    plan_age_ticks: float = 0.0
    """Age of the newest chunk, ticks (recent median)."""
    stages: Float[np.ndarray, "T S"] = field(default_factory=lambda: np.zeros((0, len(TICK_STAGES)), np.float32))
    """Milliseconds that each of the last ten seconds' ticks spent on each of TICK_STAGES, newest last."""


@register
@dataclass(frozen=True, kw_only=True)
class TrialRow:
    """One line of the history table."""

    trial: int
    scene_seed: int
    attempts: int
    success: bool
    judged_by: str
    flagged: int
    """Chunks flagged over the trial."""
    seconds: float
    note: str = ""
    counted: bool = True
    """False for a trial that began at reduced speed, or in which a person helped: not for statistics."""


@register
@dataclass(frozen=True, kw_only=True)
class LogLine:
    stamp: float
    level: str
    """"info", "warning" or "error"."""
    text: str


@register
@dataclass(frozen=True, kw_only=True)
class Telemetry:
    """A snapshot of the app, published at 15 Hz."""

    seq: int
    stamp: float
    state: State
    reason: str = ""
    """Why (fault text, what the app waits for)."""
    session: str = ""
    task: str = ""
    method: str = ""
    policy_version: str = ""
    engine: str = ""
    """What runs the policy's network."""
    engine_refused: tuple[str, ...] = ()
    """Engines that should have run it and could not: each "name: error"."""
    trial: int = 0
    """1-based."""
    trials: int = 0
    """0 when endless."""
    attempt: int = 0
    max_attempts: int = 0
    scene_seed: int = 0
    tick: int = 0
    horizon: int = 0
    rate: float = 30.0
    chunk_horizon: int = 8
    values: Float[np.ndarray, "T"] = field(default_factory=lambda: np.zeros(0))
    """V(s_t) of the attempt on show, NaN where not computed: the running one, or the failed one while adapting."""
    value_changes: Float[np.ndarray, "C"] = field(default_factory=lambda: np.zeros(0))
    """ΔV by chunk, once an attempt has failed."""
    threshold: float = float("nan")
    """ΔV at or below which chunks were flagged."""
    flagged: tuple[int, ...] = ()
    """Ticks at which flagged chunks begin."""
    adaptation: tuple[AdaptationStep, ...] = ()
    """Gradient steps of the running or latest adaptation."""
    adaptation_status: str = ""
    """"", "attribution", "candidates", "update", or the Adaptation.status it ended with."""
    pairs: int = 0
    homing_progress: float = 0.0
    countdown: float = 0.0
    """Seconds until the announced retry; 0 when none is announced."""
    robot: RobotStatus | None = None
    joints: Float[np.ndarray, "J"] = field(default_factory=lambda: np.zeros(0))
    eef: Pose | None = None
    gripper: float = 0.0
    action: Float[np.ndarray, "A"] = field(default_factory=lambda: np.zeros(0))
    chunk_path: Float[np.ndarray, "H 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    """Positions the newest chunk would lead through, metres, base frame."""
    loop: LoopHealth = field(default_factory=LoopHealth)
    history: tuple[TrialRow, ...] = ()
    """Newest last, at most 200."""
    attempts: tuple[Judged, ...] = ()
    """Those that ended, newest last, at most 300."""
    versions: Versions = field(default_factory=Versions)
    log: tuple[LogLine, ...] = ()
    """Newest last, at most 50."""
    refusal: str = ""
    """Why the last intent was refused."""
    allowed: tuple[Intent, ...] = ()
    """Intents that apply now."""
    steering: Steering = field(default_factory=Steering)
    """A person's part in the attempt."""
    plan: PlanShown | None = None
    """The plan of trials that is run, if one is."""
    scene: SceneShown | None = None
    """A plan's real scene that is being rebuilt."""


@register
@dataclass(frozen=True, kw_only=True)
class OperatorIntent:
    """From the page to the app."""

    intent: Intent
    operator: str = ""
    stamp: float = 0.0


@register
@dataclass(frozen=True, kw_only=True)
class PagePresence:
    """From the page to the app, several times a second: somebody who may act has it open, or nobody has."""

    clients: int
    """1 while the viewer who holds control answers, else 0."""


@register
@dataclass(frozen=True, kw_only=True)
class StopRequest:
    """From the page straight to the hw server's stop socket."""

    source: str
    stamp: float
    """Of the asker's clock; nothing is decided by it."""


@register
@dataclass(frozen=True, kw_only=True)
class StopAck:
    latched: float
    """Monotonic seconds at which the hw server latched, of its own clock."""


@register
@dataclass(frozen=True, kw_only=True)
class BodyMesh:
    """A visual mesh in its body's frame."""

    body: int
    """Row of View.body_poses."""
    vertices: Float[np.ndarray, "V 3"]
    faces: np.ndarray
    """int32, F × 3."""
    rgba: tuple[float, float, float, float]


@register
@dataclass(frozen=True, kw_only=True)
class SceneGeometry:
    """What the 3D view draws; asked for once from the hw server."""

    meshes: tuple[BodyMesh, ...]
    body_names: tuple[str, ...]


@register
@dataclass(frozen=True, kw_only=True)
class GeometryRequest:
    pass


@register
@dataclass(frozen=True, kw_only=True)
class CameraHealth:
    """Of one camera, since the hw server's start."""

    frames: int = 0
    """New pictures."""
    dropped: int = 0
    """Missing between two that came."""
    stale: int = 0
    """Too old when they came."""
    frozen: int = 0
    """The picture before once more."""
    reopened: int = 0
    """Times it was lost and came back."""
    age: float = 0.0
    """Of the newest new picture, seconds."""


@register
@dataclass(frozen=True, kw_only=True)
class View:
    """From the hw server to the page, at 15 Hz: operator-size pictures and where every body is."""

    seq: int
    stamp: float
    """Of the hw server's own clock."""
    jpegs: Mapping[str, bytes]
    """Camera name to JPEG at the operator's size."""
    body_poses: Float[np.ndarray, "B 7"]
    """Position and xyzw quaternion by body, metres, base frame."""
    status: RobotStatus
    cameras: Mapping[str, CameraHealth] = field(default_factory=dict)
    """By view name; empty for pictures that are drawn."""
