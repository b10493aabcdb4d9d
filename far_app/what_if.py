"""What the attempt view asks of the app and hears back: the values that need torch, which the page never loads.

A question goes the way of intents, answers the way of telemetry. The newest question counts; an older one under way is
cancelled. Numpy only; answered by far_app/methods/what_if.py.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from far_app.types import AdaptationStep, Contrast, FlagCorrection
from far_app.wire import register

RECORDED = "recorded V"
"""The critic that judged while the attempt ran: V as it was recorded."""


@register
@dataclass(frozen=True, kw_only=True)
class Question:
    """About one attempt: V under a critic, the positives of these chunks, and on demand the adaptation once more."""

    number: int
    """Counts up; an answer carries its question's."""
    file: str
    """The attempt's, relative to the session's folder."""
    critic: str = RECORDED
    """One of Answerer.critics."""
    ticks: tuple[int, ...] = ()
    """Chunks to find positives for."""
    adapt: bool = False
    """Learn from them too, with the recorded settings."""


@register
@dataclass(frozen=True, kw_only=True)
class Moved:
    """Chunks sampled at a flagged state from the same noise, before and after the adaptation."""

    tick: int
    before: Float[np.ndarray, "N H A"]
    after: Float[np.ndarray, "N H A"]


@register
@dataclass(frozen=True, kw_only=True)
class Answer:
    """Sent when it is known more: after V, after the positives, after each gradient step, at the end."""

    number: int
    file: str
    critic: str
    values: Float[np.ndarray, "V"] = field(default_factory=lambda: np.zeros(0))
    """V(s_0) … V(s_T) under the critic."""
    contrasts: tuple[Contrast, ...] = ()
    history: tuple[AdaptationStep, ...] = ()
    moved: tuple[Moved, ...] = ()
    stage: str = ""
    """What is being done now; "" at the end."""
    note: str = ""
    """What to know about it: another policy than the one that acted, a guard that stopped."""
    error: str = ""


@register
@dataclass(frozen=True, kw_only=True)
class Answerer:
    """Once a second: somebody answers questions here."""

    critics: tuple[str, ...]
    """RECORDED and the files that can be chosen."""
    said: str = ""
    """The latest it has to say: a correction or a mark that could not be stored."""


@register
@dataclass(frozen=True, kw_only=True)
class CorrectFlag:
    """The operator's word on a chunk, from the attempt view to whoever keeps the session: the running app, or
    `far replay` once it is over."""

    session: str
    trial: int
    attempt: int
    correction: FlagCorrection
