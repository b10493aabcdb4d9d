"""A failed attempt on the page: the chunk to blame, the frames at its start and its end, the value curve."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from far_app.config import AttributionConfig
from far_app.learning.attribution import flag, value_change
from far_app.recording.attempt_reader import AttemptRecording
from far_app.types import Observation, Outcome

HORIZON = 8
"""H where no chunk was recorded."""
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 88]


@dataclass(frozen=True, kw_only=True)
class Blame:
    """What of a failed attempt was flagged."""

    values: Float[np.ndarray, "T+1"]
    changes: Float[np.ndarray, "C"]
    threshold: float
    flagged: tuple[int, ...]
    horizon: int
    afterwards: bool
    """Worked out for this page: the session learnt nothing from the attempt."""

    @property
    def worst(self) -> int | None:
        """The flagged chunk of the largest drop."""
        known = [t for t in self.flagged if t < len(self.changes) and np.isfinite(self.changes[t])]
        return min(known, key=lambda t: self.changes[t], default=None)


def blame(recording: AttemptRecording, config: AttributionConfig) -> Blame:
    """As the session attributed it, else from the V(s_t) recorded in the attempt's steps."""
    lesson = recording.adaptation
    if lesson is not None and lesson.flagged:
        horizon = len(lesson.values) - len(lesson.value_changes)
        return Blame(
            values=lesson.values, changes=lesson.value_changes, threshold=lesson.threshold, flagged=lesson.flagged,
            horizon=horizon, afterwards=False,
        )  # fmt: skip
    horizon = len(recording.chunks[0].actions) if recording.chunks else HORIZON
    values = np.array([*(step.value for step in recording.steps), np.nan])
    changes = value_change(values, horizon)
    flags = flag(changes, config)
    return Blame(
        values=values, changes=changes, threshold=flags.threshold, flagged=flags.ticks, horizon=horizon, afterwards=True
    )


def card(recording: AttemptRecording, outcome: Outcome | None, config: AttributionConfig, name: str) -> str:
    """HTML."""
    known = blame(recording, config)
    seen = [step.observation for step in recording.steps]
    if recording.final is not None:
        seen.append(recording.final)
    worst = known.worst
    if worst is not None:
        moments = {f"t = {worst}, before": worst, f"t = {worst + known.horizon}, after": worst + known.horizon}
        drop = f"ΔV {known.changes[worst]:+.3g} over ticks {worst}–{worst + known.horizon}"
        how = ", worked out afterwards from the recorded V" if known.afterwards else ""
        said = f"worst of {len(known.flagged)} flagged chunks: {drop} (threshold {known.threshold:.3g}{how})"
    else:
        moments = {"first frame": 0, "last frame": len(seen) - 1}
        said = "nothing is flagged: no V(s) was recorded"
    pictures = "".join(thumbnails(seen, tick, words) for words, tick in moments.items() if 0 <= tick < len(seen))
    return (
        f'<article><h3>{html.escape(name)}</h3><p>{verdict(recording, outcome)}</p><p class="dim">{said}</p>'
        f'<div class="row"><div class="frames">{pictures}</div>{curve(known)}</div></article>'
    )


def verdict(recording: AttemptRecording, outcome: Outcome | None) -> str:
    """Who said so, and what came of it."""
    parts = [f"{len(recording.steps)} ticks"]
    if outcome is not None:
        parts.insert(0, f"<b>failure</b> by {html.escape(outcome.judged_by.value)}")
        parts += [f"“{html.escape(outcome.note)}”"] * bool(outcome.note)
    lesson = recording.adaptation
    if lesson is not None and lesson.status != "none":
        parts.append(f"{html.escape(lesson.status)}: {lesson.pairs} pairs, {lesson.base_version} → {lesson.version}")
    parts += [f"! {html.escape(problem)}" for problem in recording.problems]
    return " · ".join(parts)


def thumbnails(seen: list[Observation], tick: int, words: str) -> str:
    images: Mapping[str, np.ndarray] = seen[tick].images
    pictures = "".join(
        f'<img alt="{html.escape(camera)} at tick {tick}" src="{data_url(images[camera])}">' for camera in images
    )
    return f"<figure>{pictures}<figcaption>{html.escape(words)}</figcaption></figure>"


def data_url(image: UInt8[np.ndarray, "H W 3"]) -> str:
    done, jpeg = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), _JPEG)
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg.tobytes()).decode()}" if done else ""


def curve(known: Blame) -> str:
    """V(s_t) as inline SVG, flagged chunks shaded, the worst one darker."""
    values, width, height, edge = np.asarray(known.values, float), 460.0, 130.0, 6.0
    finite = np.isfinite(values)
    if finite.sum() < 2:
        return ""
    low, high = float(values[finite].min()), float(values[finite].max())
    last = max(1, len(values) - 1)

    def x(tick: float) -> float:
        return edge + (width - 2 * edge) * tick / last

    def y(value: float) -> float:
        return edge + (height - 2 * edge) * (high - value) / max(high - low, 1e-9)

    def shade(tick: int, kind: str) -> str:
        return f'<rect class="{kind}" x="{x(tick):.1f}" y="0" width="{x(known.horizon) - edge:.1f}" height="{height}"/>'

    shades = "".join(shade(tick, "flagged") for tick in known.flagged)
    shades += shade(known.worst, "worst") if known.worst is not None else ""
    points = " ".join(f"{x(t):.1f},{y(values[t]):.1f}" for t in range(len(values)) if finite[t])
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="V over ticks">{shades}'
        f'<polyline points="{points}"/><text x="{edge}" y="14">V(s) {high:.2f}</text>'
        f'<text x="{edge}" y="{height - 4:.0f}">{low:.2f}</text></svg>'
    )
