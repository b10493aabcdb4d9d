"""Trials of recorded sessions as they ended, and what they say: success by attempt, paired differences. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from far_app.recording.reader import SessionRecording
from far_app.recording.schema import LogEntry
from far_app.session_states import Intent
from far_app.statistics import mcnemar, paired_difference, wilson

APART = ("reduced_speed", "taken_over")
"""Events that leave their trial out of every figure: it was not the method's own doing alone."""


@dataclass(frozen=True, kw_only=True)
class Compared:
    """What distinguishes one way of trying from another."""

    task: str
    method: str
    policy: str


@dataclass(frozen=True, kw_only=True)
class TrialOutcome:
    """A trial that ended: solved, or out of attempts."""

    session: str
    trial: int
    scene: int
    solved_by: int | None
    """The attempt that succeeded; None when none did."""
    attempts: int
    repetition: int = 0
    """A plan's, 1-based; 0 outside of one."""


@dataclass(frozen=True, kw_only=True)
class Group:
    """Trials of one way of trying."""

    what: Compared
    max_attempts: int
    trials: tuple[TrialOutcome, ...]
    unfinished: int
    """Trials that were skipped, cut off, begun at reduced speed, helped by a person, marked unsure or not yet over: in
    no figure."""

    def solved(self, attempts: int) -> list[bool]:
        return [t.solved_by is not None and t.solved_by <= attempts for t in self.trials]


@dataclass(frozen=True, kw_only=True)
class Rate:
    solved: int
    trials: int

    @property
    def interval(self) -> tuple[float, float]:
        """95 %, Wilson."""
        return wilson(self.solved, self.trials)


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Left − right over the same scenes, points in [−1, 1]."""

    left: str
    right: str
    scenes: int
    mean: float
    low: float
    high: float
    only_left: int
    only_right: int
    p: float
    """Exact McNemar, two-sided."""


def groups(sessions: Sequence[SessionRecording], names: Mapping[str, str] | None = None) -> list[Group]:
    """By what was compared, in order of appearance. `names`: what a plan's methods are to be called, where not by their
    own names."""
    found: dict[Compared, list[TrialOutcome]] = {}
    unfinished: dict[Compared, int] = {}
    limits: dict[Compared, int] = {}
    for session in sessions:
        ended = {t.trial: t for t in ended_trials(session)}
        for entry in session.log:
            if entry.event == "trial_started":
                what, trial = _compared(session, entry, names or {}), ended.get(entry.trial)
                found.setdefault(what, []).extend([trial] if trial else [])
                unfinished[what] = unfinished.get(what, 0) + (trial is None)
                known = (allowed(session, entry.trial) or 1, trial.attempts if trial else 1)
                limits[what] = max(limits.get(what, 1), *known)
    return [
        Group(what=what, max_attempts=limits[what], trials=tuple(trials), unfinished=unfinished[what])
        for what, trials in found.items()
    ]


def _compared(session: SessionRecording, started: LogEntry, names: Mapping[str, str]) -> Compared:
    """What a trial counts for: the session's method, or its own in a plan."""
    info = session.header.info
    method = str(started.detail.get("method") or info.method)
    blinded = method in names
    policy = "" if blinded else str(started.detail.get("policy") or info.policy)
    return Compared(task=info.task, method=names.get(method, method), policy=policy)


def ended_trials(session: SessionRecording) -> list[TrialOutcome]:
    """Trials that ended by themselves, under the last word on each attempt; not those that were skipped, cut off, begun
    at reduced speed, helped by a person, marked unsure, or are not yet over."""
    started = {e.trial: e.detail for e in session.log if e.event == "trial_started"}
    apart = {e.trial for e in session.log if e.event in APART} | {trial for trial, _ in session.unsure}
    skipped = {e.trial for e in session.log if e.event == "intent" and e.text == Intent.SKIP_TRIAL}
    over = {e.trial for e in session.log if e.event == "trial_ended"} - apart
    ended = []
    for trial in sorted(over & set(started)):
        said = {attempt: o.success for (t, attempt), o in sorted(session.marks.items()) if t == trial}
        solved_by = next((attempt for attempt, success in said.items() if success), None)
        tried = len(said) >= (allowed(session, trial) or 1) and trial not in skipped
        if solved_by is not None or (said and tried):
            ended.append(TrialOutcome(
                session=session.header.session, trial=trial, scene=int(started[trial].get("scene_seed", 0)),
                solved_by=solved_by, attempts=solved_by or len(said),
                repetition=int(started[trial].get("repetition", 0)),
            ))  # fmt: skip
    return ended


def allowed(session: SessionRecording, trial: int) -> int | None:
    """Attempts a trial may have; None when the recording does not say."""
    own = next((e.detail for e in session.log if e.event == "trial_started" and e.trial == trial), {})
    config: Mapping[str, Mapping[str, object]] = session.header.info.config
    known = own.get("max_attempts", config.get("task", {}).get("max_attempts"))
    return int(known) if isinstance(known, int) else None


def labels(found: Sequence[Group]) -> list[str]:
    """Short names that still tell the groups apart."""
    varying = [field for field in ("task", "policy") if len({getattr(g.what, field) for g in found}) > 1]
    return [" · ".join([g.what.method, *(str(getattr(g.what, field)) for field in varying)]) for g in found]


def by_attempt(group: Group) -> list[Rate]:
    """Success within 1, 2, … attempts."""
    counts = [group.solved(k) for k in range(1, group.max_attempts + 1)]
    return [Rate(solved=sum(solved), trials=len(solved)) for solved in counts]


def differences(found: Sequence[Group]) -> list[Difference]:
    """Each pair of groups on the scenes they share (the k-th trial of a scene beside the k-th), then what retrying
    gains over the first attempt."""
    names, out = labels(found), []
    for i, left in enumerate(found):
        for j, right in enumerate(found[:i]):
            if left.what.task == right.what.task:
                attempts = min(left.max_attempts, right.max_attempts)
                pairs = shared(left, right, attempts)
                if pairs:
                    out.append(difference(names[i], names[j], pairs))
    for name, group in zip(names, found, strict=True):
        if group.max_attempts > 1 and group.trials:
            pairs = list(zip(group.solved(group.max_attempts), group.solved(1), strict=True))
            out.append(difference(name, f"{name}, first attempt", pairs))
    return out


def shared(left: Group, right: Group, attempts: int) -> list[tuple[bool, bool]]:
    """Solved within so many attempts, by scene and repetition."""

    def numbered(group: Group) -> dict[tuple[int, int], bool]:
        seen: dict[int, int] = {}
        out = {}
        for trial, solved in zip(group.trials, group.solved(attempts), strict=True):
            seen[trial.scene] = seen.get(trial.scene, 0) + 1
            out[trial.scene, trial.repetition or seen[trial.scene]] = solved
        return out

    ours, theirs = numbered(left), numbered(right)
    return [(ours[key], theirs[key]) for key in sorted(ours.keys() & theirs.keys())]


def difference(left: str, right: str, pairs: Sequence[tuple[bool, bool]]) -> Difference:
    """Of scenes solved (left, right); at least one pair."""
    mean, low, high = paired_difference([a for a, _ in pairs], [b for _, b in pairs])
    only_left, only_right = sum(a and not b for a, b in pairs), sum(b and not a for a, b in pairs)
    return Difference(
        left=left, right=right, scenes=len(pairs), mean=mean, low=max(-1.0, low), high=min(1.0, high),
        only_left=only_left, only_right=only_right, p=mcnemar(only_left, only_right),
    )  # fmt: skip
