"""Which attempts of which sessions are exported, one at a time; a word on each that is not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from far_app.errors import RecordingError
from far_app.exchange.rollout import Rollout, Segment, human, rollout
from far_app.recording.attempt_reader import AttemptRecording, read_attempt
from far_app.recording.reader import SessionRecording, read_session
from far_app.types import Outcome

Only = Literal["all", "successes", "recoveries", "human"]


@dataclass(frozen=True, kw_only=True)
class Selection:
    """What to take."""

    only: Only = "all"
    """successes: attempts judged so by the last word; one of which a person is unsure is none. recoveries: successes
    after a failed attempt on the same scene, or in which a person stepped in. human: attempts in which a person moved
    the arm."""
    segment: Segment = "attempt"
    """recovery: from the failure's state, which is where a person first stepped in, else (a retry) its first tick, for
    the scene is as the failure left it. A first attempt without a person holds none."""


@dataclass(frozen=True, kw_only=True)
class Chosen:
    """An attempt that is taken."""

    session: SessionRecording
    recording: AttemptRecording
    outcome: Outcome
    first: int
    """Tick at which the segment begins."""


def chosen(sessions: Sequence[Path], selection: Selection, say: Callable[[str], None]) -> Iterator[Chosen]:
    """Attempts that ended and of which nothing is missing, in order; `say` hears why another one is left out. Raises
    RecordingError for a folder that holds no session or one of another schema."""
    for session in [read_session(path) for path in sessions]:
        for problem in session.problems:
            say(f"{session.path}: {problem}")
        for file in session.files:
            where = f"{session.path.name}/{file.relative_to(session.path)}"
            try:
                recording = read_attempt(file)
            except RecordingError as error:
                say(f"{where} is left out: {error}")
                continue
            why = incomplete(recording)
            if why:
                say(f"{where} is left out: {why}")
                continue
            assert recording.header is not None and recording.outcome is not None
            key = recording.header.trial, recording.header.attempt
            outcome = session.marks.get(key, recording.outcome)
            first = start_of(recording, selection.segment)
            sure = key not in session.unsure
            if not sure and selection.only in ("successes", "recoveries"):
                say(f"{where} is left out: a person is unsure how it went")
            elif wanted(recording, outcome, selection.only) and first is not None:
                yield Chosen(session=session, recording=recording, outcome=outcome, first=first)


def incomplete(recording: AttemptRecording) -> str:
    """Why an attempt cannot be an episode; "" when it can. A file that merely was not closed can."""
    if recording.abandoned:
        return f"it was abandoned ({recording.abandoned})"
    if recording.header is None or recording.outcome is None or recording.final is None or not recording.steps:
        return "; ".join(recording.problems) or "it holds no steps"
    ticks = [step.tick for step in recording.steps]
    seen = [*(step.observation for step in recording.steps), recording.final]
    if ticks != list(range(len(ticks))) or len({frozenset(o.images) for o in seen}) > 1:
        return "; ".join(recording.problems) or "steps or frames are missing"
    return ""


def wanted(recording: AttemptRecording, outcome: Outcome, only: Only) -> bool:
    assert recording.header is not None
    helped = any(human(step) for step in recording.steps)
    if only == "human":
        return helped
    if only == "recoveries":
        return outcome.success and (helped or bool(recording.header.previous))
    return outcome.success or only == "all"


def start_of(recording: AttemptRecording, segment: Segment) -> int | None:
    """The tick at which a segment begins; None when the attempt holds none."""
    if segment == "attempt":
        return 0
    helped = next((step.tick for step in recording.steps if human(step)), None)
    if helped is None and recording.header is not None and recording.header.previous:
        return 0
    return helped


def rollouts(sessions: Sequence[Path], selection: Selection, say: Callable[[str], None]) -> Iterator[Rollout]:
    """The chosen attempts as arrays; never more than one at a time in memory."""
    for one in chosen(sessions, selection, say):
        yield rollout(one.session, one.recording, one.outcome, selection.segment, one.first)
