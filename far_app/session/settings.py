"""How a session is to run, and what became of each of its trials."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from far_app.session_states import Intent


@dataclass(frozen=True, kw_only=True)
class Freshness:
    stale_after: float = 0.25
    """Age of an observation's pictures, seconds, at which the arm is held."""
    limit: float = 1.0
    """Seconds of staleness after which it is a fault."""


@dataclass(frozen=True, kw_only=True)
class SessionSettings:
    name: str
    """The session's folder under recordings/."""
    trials: int = 0
    """0 runs until the operator quits."""
    seed: int = 0
    """Scene seed of the first trial; the next has the next."""
    headless: bool = False
    """Nobody watches: a fault ends the session with an error instead of waiting for an operator."""
    adaptation_limit: float = 60.0
    """Seconds after which a retry no longer waits for its adaptation."""
    freshness: Freshness = field(default_factory=Freshness)
    await_scene: bool = False
    """Real arm: before each trial the arm is held until the operator has rebuilt the scene and cleared the
    workspace."""
    countdown: float = 0.0
    """Real arm: seconds for which each attempt is announced; a pause or a stop cancels it."""
    page_silence: float = math.inf
    """Real arm: seconds without a page that someone looks at after which the arm is held until Resume."""
    no_take_over: str = ""
    """Why a person cannot take the arm in this session; empty when one can."""
    demonstrate: Literal["", "teleop", "hand"] = ""
    """Attempts are a person's: steered (teleop), or the arm is led by hand. Each is then kept, discarded or recorded
    again, and `trials` counts those that were kept."""
    first_stretch: int = 1
    """Real arm: ticks that each tick of the session's first attempt takes; that trial is left out of statistics."""


@dataclass(frozen=True, kw_only=True)
class TrialResult:
    """One trial as the summary tells it."""

    seed: int
    attempts: int
    success: bool
    judged_by: str
    counted: bool = True
    """False for a trial that began at reduced speed, or in which a person helped."""
    word: Intent = Intent.KEEP
    """The operator's, on a demonstration: keep, discard, or record again."""
    finished: bool = True
    """It ended by itself: solved, or out of attempts; not skipped and not cut off."""
