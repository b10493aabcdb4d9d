"""The session's states and transitions: an enum and one table. Pure; the driver in session.py acts on it.

An operator's intent that does not apply now is refused with a reason; an internal event that does not apply is a bug
and raises.
"""

from __future__ import annotations

from enum import StrEnum

from far_app.wire import register


@register
class State(StrEnum):
    READY = "ready"
    """Set up, nothing moving."""
    HOMING = "homing"
    """Going to the start pose before a first attempt."""
    RUNNING = "running"
    """An attempt is under way."""
    PAUSED = "paused"
    """An attempt is held by the operator."""
    ADAPTING = "adapting"
    """After a failure: the arm goes home while FCPA runs."""
    TRIAL_DONE = "trial_done"
    AWAITING_SCENE = "awaiting_scene"
    """Hardware only: held until the operator has rebuilt the scene and says the workspace is clear."""
    STOPPED = "stopped"
    """The operator pressed STOP; only Resume leaves."""
    FAULT = "fault"
    """An arm, camera or link fault, or a breached workspace; only the operator clears it."""
    FINISHED = "finished"
    """All trials done, or ended by the operator."""


@register
class Intent(StrEnum):
    """What an operator may ask for."""

    STOP = "stop"
    PAUSE = "pause"
    RESUME = "resume"
    MARK_SUCCESS = "mark_success"
    MARK_FAILURE = "mark_failure"
    SKIP_TRIAL = "skip_trial"
    SCENE_READY = "scene_ready"
    QUIT = "quit"


class Happening(StrEnum):
    """What the program itself notices."""

    BEGIN_TRIAL = "begin_trial"
    AT_HOME = "at_home"
    """Home, and the adaptation (if any) done."""
    SUCCEEDED = "succeeded"
    FAILED_RETRY = "failed_retry"
    """Failed with an attempt left."""
    FAILED_LAST = "failed_last"
    LATCH = "latch"
    """The hw server latched on STOP."""
    FAULT = "fault"
    NO_MORE_TRIALS = "no_more_trials"
    NEED_SCENE = "need_scene"
