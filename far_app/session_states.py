"""The session's states and transitions: an enum and one table. Pure; far_app/session acts on it.

    state' = TABLE[state, event]          event: what the operator asks (Intent) or the program notices (Happening)

An operator's intent that does not apply now is refused with a reason (`refusal`, never an exception); an internal event
that does not apply is a bug and raises (`step`). The happy path needs no intent:

    READY → HOMING → RUNNING → TRIAL_DONE → HOMING …            success
                       ↳ ADAPTING → RUNNING …                   failure with an attempt left
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
    TAKEN_OVER = "taken_over"
    """An attempt is under way and a person moves the arm."""
    PAUSED = "paused"
    """An attempt is held by the operator."""
    ADAPTING = "adapting"
    """After a failure: the arm goes home while FCPA runs."""
    TRIAL_DONE = "trial_done"
    AWAITING_SCENE = "awaiting_scene"
    """Hardware only: held until the operator has rebuilt the scene and says the workspace is clear."""
    REVIEWING = "reviewing"
    """A demonstration has ended: the operator keeps it, discards it or records it again."""
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
    TAKE_OVER = "take_over"
    """A person moves the arm from here on."""
    HAND_BACK = "hand_back"
    """The policy acts again."""
    SCENE_READY = "scene_ready"
    KEEP = "keep"
    """The demonstration goes to the dataset."""
    DISCARD = "discard"
    RECORD_AGAIN = "record_again"
    """The demonstration is discarded and its scene recorded anew."""
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
    NEED_REVIEW = "need_review"
    GO_ON_ATTEMPT = "go_on_attempt"
    """A held attempt goes on."""
    GO_ON_HOMING = "go_on_homing"
    """The way home goes on after a hold."""
    GO_ON_ADAPTING = "go_on_adapting"
    """The way home goes on after a hold, the adaptation still running."""


Event = Intent | Happening


class ImpossibleTransition(RuntimeError):
    """An event that cannot happen in this state: a bug of ours."""


def _table() -> dict[tuple[State, Event], State]:
    s, i, h = State, Intent, Happening
    table: dict[tuple[State, Event], State] = {
        # a trial, from start to end, with no button
        (s.READY, h.BEGIN_TRIAL): s.HOMING,
        (s.READY, h.NEED_SCENE): s.AWAITING_SCENE,
        (s.READY, h.NO_MORE_TRIALS): s.FINISHED,
        (s.HOMING, h.AT_HOME): s.RUNNING,
        (s.RUNNING, h.SUCCEEDED): s.TRIAL_DONE,
        (s.RUNNING, h.FAILED_RETRY): s.ADAPTING,
        (s.RUNNING, h.FAILED_LAST): s.TRIAL_DONE,
        (s.ADAPTING, h.AT_HOME): s.RUNNING,
        (s.TRIAL_DONE, h.BEGIN_TRIAL): s.HOMING,
        (s.TRIAL_DONE, h.NEED_SCENE): s.AWAITING_SCENE,
        (s.TRIAL_DONE, h.NO_MORE_TRIALS): s.FINISHED,
        (s.AWAITING_SCENE, i.SCENE_READY): s.READY,
        (s.TRIAL_DONE, h.NEED_REVIEW): s.REVIEWING,
        (s.READY, h.NEED_REVIEW): s.REVIEWING,  # after a stop
        (s.REVIEWING, i.KEEP): s.TRIAL_DONE,
        (s.REVIEWING, i.DISCARD): s.TRIAL_DONE,
        (s.REVIEWING, i.RECORD_AGAIN): s.TRIAL_DONE,
        # the operator's word on the attempt; what follows is a happening of the same tick
        (s.RUNNING, i.MARK_SUCCESS): s.RUNNING,
        (s.RUNNING, i.MARK_FAILURE): s.RUNNING,
        (s.PAUSED, i.MARK_SUCCESS): s.RUNNING,
        (s.PAUSED, i.MARK_FAILURE): s.RUNNING,
        (s.ADAPTING, i.MARK_SUCCESS): s.TRIAL_DONE,  # cancels the adaptation
        (s.RUNNING, i.SKIP_TRIAL): s.RUNNING,
        (s.PAUSED, i.SKIP_TRIAL): s.RUNNING,
        (s.HOMING, i.SKIP_TRIAL): s.TRIAL_DONE,
        (s.ADAPTING, i.SKIP_TRIAL): s.TRIAL_DONE,
        # a person has the arm: the attempt goes on, and ends as it would under the policy
        (s.RUNNING, i.TAKE_OVER): s.TAKEN_OVER,
        (s.PAUSED, i.TAKE_OVER): s.TAKEN_OVER,  # a paused attempt's; refused on the way home (session/operator.py)
        (s.TAKEN_OVER, i.HAND_BACK): s.RUNNING,
        (s.TAKEN_OVER, i.PAUSE): s.PAUSED,  # Resume then gives the arm to the policy
        (s.TAKEN_OVER, i.MARK_SUCCESS): s.RUNNING,
        (s.TAKEN_OVER, i.MARK_FAILURE): s.RUNNING,
        (s.TAKEN_OVER, i.SKIP_TRIAL): s.RUNNING,
        (s.TAKEN_OVER, h.SUCCEEDED): s.TRIAL_DONE,
        (s.TAKEN_OVER, h.FAILED_RETRY): s.ADAPTING,
        (s.TAKEN_OVER, h.FAILED_LAST): s.TRIAL_DONE,
        # pause, and leaving a pause, a stop or a fault: READY for an instant, then what was interrupted goes on
        (s.RUNNING, i.PAUSE): s.PAUSED,
        (s.HOMING, i.PAUSE): s.PAUSED,
        (s.ADAPTING, i.PAUSE): s.PAUSED,
        (s.PAUSED, i.RESUME): s.READY,
        (s.STOPPED, i.RESUME): s.READY,
        (s.FAULT, i.RESUME): s.READY,
        (s.READY, h.GO_ON_ATTEMPT): s.RUNNING,
        (s.READY, h.GO_ON_HOMING): s.HOMING,
        (s.READY, h.GO_ON_ADAPTING): s.ADAPTING,
        # a way home may ask the operator to take what the hand holds
        (s.HOMING, i.RESUME): s.HOMING,
        (s.ADAPTING, i.RESUME): s.ADAPTING,
        # an attempt that a stop or a fault ended is accounted for after the operator cleared it
        (s.READY, h.SUCCEEDED): s.TRIAL_DONE,
        (s.READY, h.FAILED_RETRY): s.ADAPTING,
        (s.READY, h.FAILED_LAST): s.TRIAL_DONE,
    }
    for state in State:
        if state is s.FINISHED:
            continue
        table[state, i.QUIT] = s.FINISHED
        table[state, h.FAULT] = s.FAULT
        if state is not s.FAULT:
            table[state, i.STOP] = s.STOPPED
            table[state, h.LATCH] = s.STOPPED
    table[s.FAULT, i.STOP] = s.FAULT  # a stop is never refused; the fault stays to be cleared
    table[s.FAULT, h.LATCH] = s.FAULT
    return table


TABLE = _table()

_WHY: dict[Intent, str] = {
    Intent.STOP: "the session has ended",
    Intent.PAUSE: "nothing is moving that could be paused",
    Intent.RESUME: "nothing is paused, stopped or faulty",
    Intent.MARK_SUCCESS: "no attempt is under way or just failed",
    Intent.MARK_FAILURE: "no attempt is under way",
    Intent.SKIP_TRIAL: "no trial is under way that could be skipped",
    Intent.TAKE_OVER: "only an attempt under way can be taken over",
    Intent.HAND_BACK: "nobody has taken over",
    Intent.SCENE_READY: "the app does not wait for a scene",
    Intent.KEEP: "no demonstration waits for your word",
    Intent.DISCARD: "no demonstration waits for your word",
    Intent.RECORD_AGAIN: "no demonstration waits for your word",
    Intent.QUIT: "the session has ended",
}


def step(state: State, event: Event) -> State:
    """The next state. Raises ImpossibleTransition for a pair the table lacks (ask `refusal` first for an intent)."""
    try:
        return TABLE[state, event]
    except KeyError:
        raise ImpossibleTransition(f"{type(event).__name__} '{event}' cannot happen in state '{state}'") from None


def refusal(state: State, intent: Intent) -> str:
    """Why an intent does not apply now; empty when it does."""
    if (state, intent) in TABLE:
        return ""
    hint = "; resume first" if state in (State.STOPPED, State.FAULT) else ""
    return f"'{intent}' is refused in state '{state}': {_WHY[intent]}{hint}"


def allowed(state: State) -> tuple[Intent, ...]:
    """The intents that apply now."""
    return tuple(intent for intent in Intent if (state, intent) in TABLE)
