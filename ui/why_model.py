"""What the attempt view shows of one attempt, under the recorded attribution or a what-if. Pure: no viser, no sockets.

ΔV_t = V(s_{t+H}) − V(s_t)          flagged: the lowest ρ per cent, then the operator's corrections
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from far_app.config import AttributionConfig
from far_app.learning.attribution import corrected, flag, value_change
from far_app.recording.attempt_reader import AttemptRecording
from far_app.types import Contrast, FlagCorrection, Observation
from far_app.what_if import RECORDED, Answer

RHO, HORIZON = 10.0, 8
"""Where a recording does not tell its own (paper, hyperparameter table)."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """The what-if: how chunks are flagged. `recorded` keeps what was flagged when it happened."""

    rho: float = RHO
    horizon: int = HORIZON
    critic: str = RECORDED
    recorded: bool = True


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What a session's settings tell about its attempts."""

    rho: float = RHO
    scale: float = 0.008
    """Metres of an action of 1 in one tick."""

    @classmethod
    def of(cls, config: Any, rig: Any) -> Setting:
        """From session.json; what it lacks is the default."""
        return cls(
            rho=float(_dig(config, "run", "retry", "attribution", "rho") or RHO),
            scale=float(_dig(rig, "scale", "translation") or 0.008),
        )


def _dig(table: Any, *keys: str) -> Any:
    for key in keys:
        table = table.get(key) if hasattr(table, "get") else None
    return table


@dataclass(frozen=True, kw_only=True)
class Case:
    """One attempt as it lies on the disk, by tick."""

    name: str
    outcome: str
    failed: bool
    length: int
    """T + 1: states s_0 … s_T."""
    values: Float[np.ndarray, "T+1"]
    """NaN where V is not recorded."""
    horizon: int
    flagged: tuple[int, ...] = ()
    """As flagged when it happened, corrections that came in time included."""
    threshold: float = math.nan
    attributed: bool = False
    """The recording holds an attribution."""
    observations: dict[int, Observation] = field(default_factory=dict)
    sent: dict[int, Float[np.ndarray, "A"]] = field(default_factory=dict)
    contrasts: dict[int, Contrast] = field(default_factory=dict)
    version: str = ""
    lesson: str = ""
    """What the adaptation came to."""
    problems: tuple[str, ...] = ()

    def frame(self, tick: int, camera: str) -> UInt8[np.ndarray, "H W 3"] | None:
        """What the camera saw at s_tick; None where no frame is left."""
        observation = self.observations.get(tick)
        return observation.images.get(camera) if observation is not None else None

    def cameras(self) -> tuple[str, ...]:
        names = {name: None for o in self.observations.values() for name in o.images}
        return tuple(names)


def case_of(recording: AttemptRecording) -> Case:
    """From a recording, whole or cut off."""
    observations = {step.tick: step.observation for step in recording.steps}
    last = max(observations, default=-1)
    if recording.final is not None and recording.steps:
        observations[last + 1] = recording.final
    length = max(observations, default=-1) + 1
    values = np.full(length, np.nan)
    for step in recording.steps:
        values[step.tick] = step.value
    for chunk in recording.chunks:
        if 0 <= chunk.tick < length and not np.isfinite(values[chunk.tick]):
            values[chunk.tick] = chunk.value
    a = recording.adaptation
    attributed = a is not None and len(a.value_changes) > 0 and np.isfinite(a.value_changes).any()
    if a is not None and attributed and len(a.values) == length:
        values = np.asarray(a.values, float)
    horizon = next((len(c.actions) for c in recording.chunks), HORIZON)
    header, outcome = recording.header, recording.outcome
    name = f"trial {header.trial} · attempt {header.attempt}" if header else recording.path.stem
    problems = list(recording.problems)
    if recording.abandoned:
        problems.append(f"abandoned: {recording.abandoned}")
    if not np.isfinite(values).any():
        problems.append("no V is recorded: the method ran without a critic; choose a critic")
    return Case(
        name=name, outcome="cut off" if outcome is None else "success" if outcome.success else "failure",
        failed=outcome is None or not outcome.success, length=length, values=values, horizon=horizon,
        flagged=tuple(a.flagged) if a is not None and attributed else (), attributed=bool(attributed),
        threshold=a.threshold if a is not None and attributed else math.nan, observations=observations,
        sent={s.tick: np.where(np.isfinite(s.sent), s.sent, s.commanded) for s in recording.steps},
        contrasts={c.tick: c for c in a.contrasts} if a is not None else {},
        version=header.policy_version if header else "",
        lesson=f"{a.status}, {a.pairs} pairs → {a.version}" if a is not None and a.status != "none" else "",
        problems=tuple(problems),
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Attribution:
    """Which chunks are flagged now."""

    values: Float[np.ndarray, "T+1"]
    changes: Float[np.ndarray, "C"]
    threshold: float
    flagged: tuple[int, ...]
    words: dict[int, FlagCorrection]
    """The operator's last word by tick."""
    horizon: int
    source: str
    """Where the flags come from, for people."""

    def rank(self, tick: int) -> tuple[int, int]:
        """(place, of): 1 is the largest drop; (0, of) where ΔV is unknown."""
        known = self.changes[np.isfinite(self.changes)]
        if not 0 <= tick < len(self.changes) or not np.isfinite(self.changes[tick]):
            return 0, len(known)
        return int((known < self.changes[tick]).sum()) + 1, len(known)


def attribution(
    case: Case, choice: Choice, corrections: Sequence[FlagCorrection] = (), answer: Answer | None = None
) -> Attribution:
    """The recorded attribution where nothing else is asked for; otherwise the percentile rule on these values."""
    values = case.values
    if choice.critic != RECORDED:
        values = np.full(case.length, np.nan)
        if answer is not None and answer.critic == choice.critic:
            values[: len(answer.values)] = answer.values[: case.length]
    words = {c.tick: c for c in corrections}
    changes = value_change(values, choice.horizon)
    if choice.recorded and case.attributed:
        flagged, threshold, source = case.flagged, case.threshold, "as flagged then"
    else:
        flags = flag(changes, AttributionConfig(rho=choice.rho))
        flagged, threshold = flags.ticks, flags.threshold
        source = f"what if: ρ {choice.rho:g} %, H {choice.horizon}"
        if choice.critic != RECORDED:
            source += f", {choice.critic.rsplit('/', 1)[-1]}"
        elif choice.recorded:
            source = f"computed now, ρ {choice.rho:g} %: no attribution is recorded"
    return Attribution(
        values=values, changes=changes, threshold=threshold, words=words, horizon=choice.horizon, source=source,
        flagged=corrected(flagged, tuple(corrections), len(changes)),
    )  # fmt: skip


def beside(flagged: Sequence[int], tick: int, direction: int) -> int | None:
    """The next flagged chunk in that direction, around the end; None when there is none."""
    if not flagged:
        return None
    later = [t for t in flagged if (t > tick if direction > 0 else t < tick)]
    around = flagged[0] if direction > 0 else flagged[-1]
    return (later[0] if direction > 0 else later[-1]) if later else around


def deepest(found: Attribution) -> int:
    """The flagged chunk with the largest drop: where one looks first; 0 when none is flagged."""
    known = [t for t in found.flagged if np.isfinite(found.changes[t])]
    return min(known, key=lambda t: found.changes[t], default=found.flagged[0] if found.flagged else 0)


def executed(case: Case, tick: int, horizon: int) -> Float[np.ndarray, "H A"]:
    """The chunk that was sent from t on, as far as its steps are there."""
    actions = []
    for t in range(tick, tick + horizon):
        if t not in case.sent:
            break
        actions.append(case.sent[t])
    return np.array(actions, dtype=float).reshape(len(actions), -1)


def path(case: Case, tick: int, actions: Float[np.ndarray, "H A"], scale: float) -> Float[np.ndarray, "H+1 3"]:
    """Where a chunk leads the hand from s_t, metres: the position plus the sum of its translations."""
    observation = case.observations.get(tick)
    if observation is None or len(actions) == 0:
        return np.zeros((0, 3))
    start = np.asarray(observation.eef.position, float)
    return np.vstack([start, start + scale * np.cumsum(np.asarray(actions)[:, :3], axis=0)])


def trail(case: Case) -> tuple[list[int], Float[np.ndarray, "N 3"]]:
    """Ticks and positions of the hand over the attempt."""
    ticks = sorted(case.observations)
    points = [np.asarray(case.observations[t].eef.position, float) for t in ticks]
    return ticks, np.array(points).reshape(-1, 3)


def q_colors(q: Sequence[float] | Float[np.ndarray, "K"], negative: float) -> UInt8[np.ndarray, "K 3"]:
    """Amber at the executed chunk's Q, green at the best."""
    low, high = np.array([235, 150, 0.0]), np.array([0, 190, 90.0])
    values = np.asarray(q, float)
    span = max(float(values.max()) - negative, 1e-9) if len(values) else 1.0
    share = np.clip((values - negative) / span, 0.0, 1.0)
    return np.round(low + share[:, None] * (high - low)).astype(np.uint8)


def with_answer(case: Case, answer: Answer | None) -> Case:
    """The case with what was computed for it; what was recorded stays where nothing was asked."""
    if answer is None or not answer.contrasts:
        return case
    return replace(case, contrasts={**case.contrasts, **{c.tick: c for c in answer.contrasts}})
