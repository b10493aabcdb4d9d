"""The state table, exhaustively over states × events."""

import itertools

import pytest

from far_app.session_states import TABLE, Happening, ImpossibleTransition, Intent, State, allowed, refusal, step

STATES, INTENTS, HAPPENINGS = list(State), list(Intent), list(Happening)


def test_every_pair_either_leads_to_a_state_or_raises():
    for state, event in itertools.product(STATES, [*INTENTS, *HAPPENINGS]):
        if (state, event) in TABLE:
            assert step(state, event) is TABLE[state, event]
        else:
            with pytest.raises(ImpossibleTransition, match=f"'{event}' cannot happen in state '{state}'"):
                step(state, event)


def test_an_intent_is_refused_with_a_reason_exactly_where_the_table_lacks_it():
    for state, intent in itertools.product(STATES, INTENTS):
        reason = refusal(state, intent)
        assert (reason == "") == ((state, intent) in TABLE)
        assert (intent in allowed(state)) == (reason == "")
        if reason:
            assert f"'{intent}'" in reason and f"'{state}'" in reason and ": " in reason


def test_finished_is_the_only_state_without_a_way_out():
    for state in STATES:
        ways = {target for (origin, _), target in TABLE.items() if origin is state and target is not state}
        assert bool(ways) == (state is not State.FINISHED)


def test_stop_and_quit_apply_everywhere_but_at_the_end():
    for state in STATES:
        assert (Intent.STOP in allowed(state)) == (state is not State.FINISHED)
        assert (Intent.QUIT in allowed(state)) == (state is not State.FINISHED)


def test_only_resume_or_quit_leaves_a_stop_and_a_fault():
    for state in (State.STOPPED, State.FAULT):
        leaving = {event for (origin, event), target in TABLE.items() if origin is state and target is not state}
        assert leaving <= {Intent.RESUME, Intent.QUIT, Happening.FAULT}
    assert all(
        target in (State.FAULT, State.READY, State.FINISHED)
        for (origin, _), target in TABLE.items()
        if origin is State.FAULT
    )


def test_every_state_is_reached_from_ready():
    reached, frontier = {State.READY}, [State.READY]
    while frontier:
        origin = frontier.pop()
        for (state, _), target in TABLE.items():
            if state is origin and target not in reached:
                reached.add(target)
                frontier.append(target)
    assert reached == set(STATES)


def test_the_happy_path_needs_no_intent():
    state = State.READY
    for event, expected in [
        (Happening.BEGIN_TRIAL, State.HOMING),
        (Happening.AT_HOME, State.RUNNING),
        (Happening.FAILED_RETRY, State.ADAPTING),
        (Happening.AT_HOME, State.RUNNING),
        (Happening.SUCCEEDED, State.TRIAL_DONE),
        (Happening.BEGIN_TRIAL, State.HOMING),
        (Happening.AT_HOME, State.RUNNING),
        (Happening.FAILED_LAST, State.TRIAL_DONE),
        (Happening.NO_MORE_TRIALS, State.FINISHED),
    ]:
        state = step(state, event)
        assert state is expected


def test_motion_never_follows_a_stop_without_resume():
    moving = {State.HOMING, State.RUNNING, State.TAKEN_OVER, State.ADAPTING}
    leads_on = (Intent.MARK_SUCCESS, Intent.MARK_FAILURE, Intent.SKIP_TRIAL, Intent.TAKE_OVER)
    for (origin, event), target in TABLE.items():
        if origin in (State.STOPPED, State.FAULT, State.PAUSED) and target in moving:
            assert origin is State.PAUSED and event in leads_on
