"""How far a plan is, and what it says so far: read from the recordings themselves, so that nothing else need survive.

A trial counts once it ended by itself (far_app/session_report/outcomes.py says when), under the last word on each of
its attempts: a mark that is changed later changes the plan's figures. Pure but for reading sessions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from far_app.errors import ConfigError, RecordingError
from far_app.recording.reader import SessionRecording, read_session
from far_app.recording.schema import SESSION_FILE
from far_app.session_report.outcomes import Compared, Group, TrialOutcome, by_attempt, difference, ended_trials
from far_app.statistics import Z95
from far_app.trial_plan.order import Slot
from far_app.trial_plan.plan import TrialPlan, changed
from far_app.trial_plan.shown import ArmShown, DifferenceShown

Done = Mapping[Slot, TrialOutcome]


def recorded_plan(session: SessionRecording) -> Mapping[str, Any] | None:
    """The plan whose trials a session holds."""
    known = session.header.info.config.get("plan")
    return known if isinstance(known, Mapping) else None


def sessions_of(plan: TrialPlan, recordings: Path) -> list[SessionRecording]:
    """The sessions that ran trials of this plan, oldest first. Raises ConfigError where they ran another of its
    name: their trials could not be counted with this one's."""
    found = []
    for file in sorted(recordings.glob(f"*_{plan.name}*/{SESSION_FILE}")):
        try:
            session = read_session(file.parent)
        except RecordingError:
            continue  # of another schema, or not a session: in no figure
        before = recorded_plan(session)
        if before is None or before.get("name") != plan.name:
            continue
        if differing := changed(plan, before):
            raise ConfigError(
                f"{plan.file}: name is '{plan.name}', under which {file.parent} holds trials of another plan (other: "
                f"{', '.join(differing)}); give this one another name, or another --recordings"
            )
        found.append(session)
    return found


def done_in(sessions: Sequence[SessionRecording]) -> dict[Slot, TrialOutcome]:
    """The trials that count; the first of each slot."""
    done: dict[Slot, TrialOutcome] = {}
    for session in sessions:
        ended = {t.trial: t for t in ended_trials(session)}
        for entry in session.log:
            if entry.event == "trial_started" and "scene" in entry.detail and entry.trial in ended:
                slot = Slot(
                    method=str(entry.detail["method"]), scene=str(entry.detail["scene"]),
                    repetition=int(entry.detail["repetition"]),
                )  # fmt: skip
                done.setdefault(slot, ended[entry.trial])
    return done


def arm(method: str, label: str, done: Done, attempts: int) -> ArmShown:
    """Success by attempt with its intervals."""
    trials = tuple(trial for slot, trial in done.items() if slot.method == method)
    what = Compared(task="", method=label, policy="")
    rates = by_attempt(Group(what=what, max_attempts=attempts, trials=trials, unfinished=0))
    return ArmShown(
        label=label, trials=len(trials), solved=tuple(rate.solved for rate in rates),
        low=tuple(rate.interval[0] for rate in rates), high=tuple(rate.interval[1] for rate in rates),
    )  # fmt: skip


def paired(methods: Sequence[str], label: Callable[[str], str], done: Done, precision: float) -> list[DifferenceShown]:
    """Every two methods on the scenes that both have done, earlier minus later, each within its own attempts."""
    out = []
    for i, left in enumerate(methods):
        for right in methods[i + 1 :]:
            ours, theirs = _solved(left, done), _solved(right, done)
            pairs = [(ours[key], theirs[key]) for key in sorted(ours.keys() & theirs.keys())]
            out.append(shown_difference(label(left), label(right), pairs, precision))
    return out


def _solved(method: str, done: Done) -> dict[tuple[str, int], bool]:
    """By scene and repetition."""
    return {(s.scene, s.repetition): t.solved_by is not None for s, t in done.items() if s.method == method}


def shown_difference(left: str, right: str, pairs: Sequence[tuple[bool, bool]], precision: float) -> DifferenceShown:
    """Also before the first pair, when nothing is known."""
    if not pairs:
        return DifferenceShown(
            left=left, right=right, pairs=0, mean=0.0, low=-1.0, high=1.0, only_left=0, only_right=0, p=1.0,
            left_to_go=None,
        )  # fmt: skip
    found = difference(left, right, pairs)
    return DifferenceShown(
        left=left, right=right, pairs=found.scenes, mean=found.mean, low=found.low, high=found.high,
        only_left=found.only_left, only_right=found.only_right, p=found.p,
        left_to_go=trials_to_go(found.scenes, found.only_left, found.only_right, precision),
    )  # fmt: skip


def trials_to_go(pairs: int, only_left: int, only_right: int, precision: float) -> int:
    """Trials (two a pair) until the paired difference's 95 % interval is ± `precision` points.

        n = (1.96 s / w)²,   s² = (b + c + 1) / (m + 2) − ((b − c) / (m + 2))²

    with b and c the discordant pairs of m. The added ones (Agresti and Min 2005: half a pair to each cell) keep s
    above 0 while all pairs agree, when nothing can yet be said of how often they will differ. An estimate: it moves as
    pairs come in, and is no rule for stopping."""
    m = pairs + 2
    variance = (only_left + only_right + 1) / m - ((only_left - only_right) / m) ** 2
    return 2 * max(0, math.ceil(Z95**2 * variance / (precision / 100) ** 2) - pairs)
