"""Where one looks in the attempt view, and what each press does to it. Pure; the page's thread is the only caller."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum

from far_app.marks import Judged, Verdict
from far_app.what_if import RECORDED
from ui.why_model import Attribution, Case, Choice, Setting, beside


class Press(StrEnum):
    """Buttons, keys and sliders of the attempt view."""

    NEXT = "next"
    PREVIOUS = "previous"
    LATER = "later"
    EARLIER = "earlier"
    ATTEMPT_NEXT = "attempt_next"
    ATTEMPT_PREVIOUS = "attempt_previous"
    CORRECT = "correct"
    CRITIC = "critic"
    RESET = "reset"
    ADAPT = "adapt"
    MARK_SUCCESS = "mark_success"
    MARK_FAILURE = "mark_failure"
    MARK_UNSURE = "mark_unsure"
    KEEP_NOTE = "keep_note"
    TICK = "tick"
    RHO = "rho"
    HORIZON = "horizon"


VERDICTS = {
    Press.MARK_SUCCESS: Verdict.SUCCESS, Press.MARK_FAILURE: Verdict.FAILURE, Press.MARK_UNSURE: Verdict.UNSURE,
}  # fmt: skip
"""What each press says of the attempt; Press.KEEP_NOTE says nothing but its note."""


@dataclass(frozen=True, kw_only=True)
class Looking:
    """What is on show."""

    attempt: int = 0
    """Index into the session's attempts."""
    tick: int = 0
    choice: Choice = field(default_factory=Choice)
    chosen: bool = False
    """The operator has chosen an attempt: a live session's newest failure no longer takes its place."""


def fresh(attempt: int, case: Case | None, setting: Setting, *, chosen: bool = False) -> Looking:
    """An attempt as recorded."""
    horizon = case.horizon if case is not None else Choice().horizon
    return Looking(attempt=attempt, choice=Choice(rho=setting.rho, horizon=horizon), chosen=chosen)


def moved(
    looking: Looking, press: Press, value: float, case: Case, found: Attribution, critics: tuple[str, ...]
) -> Looking:
    """After a press that only changes where one looks or what is asked of the attribution."""
    last = max(case.length - 1, 0)
    choice = looking.choice
    match press:
        case Press.NEXT | Press.PREVIOUS:
            tick = beside(found.flagged, looking.tick, 1 if press is Press.NEXT else -1)
            return looking if tick is None else replace(looking, tick=tick)
        case Press.LATER | Press.EARLIER:
            step = 1 if press is Press.LATER else -1
            return replace(looking, tick=min(max(looking.tick + step, 0), last))
        case Press.TICK:
            return replace(looking, tick=min(max(round(value), 0), last))
        case Press.RHO:
            return replace(looking, choice=replace(choice, rho=min(max(value, 1.0), 100.0), recorded=False))
        case Press.HORIZON:
            return replace(looking, choice=replace(choice, horizon=max(1, round(value)), recorded=False))
        case Press.CRITIC:
            names = critics or (RECORDED,)
            at = names.index(choice.critic) if choice.critic in names else -1
            return replace(looking, choice=replace(choice, critic=names[(at + 1) % len(names)], recorded=False))
    return looking


@dataclass(frozen=True, kw_only=True)
class Offer:
    """A control: may it act, and if not, why."""

    enabled: bool
    line: str = ""
    """Below its label: a word on what it does, or why it cannot; the page adds its key."""


def offers(
    looking: Looking, case: Case | None, found: Attribution | None, *, attempts: int, critics: tuple[str, ...],
    can_correct: str, adapting: bool,
) -> dict[Press, Offer]:  # fmt: skip
    """Every button with its reason. `can_correct`: "" or why the operator's word cannot be kept."""
    nothing = "the attempt cannot be read" if case is None or found is None else ""
    if case is not None and case.length == 0:
        nothing = "no step is left"
    flags = nothing or ("" if found is not None and found.flagged else "no chunk is flagged")
    whole = found is not None and 0 <= looking.tick < len(found.changes)
    correct = nothing or can_correct or ("" if whole else "no whole chunk begins here")
    what_if = nothing or ("" if critics else "only in far replay")
    one = what_if or ("" if len(critics) > 1 else "no other: give --critic")
    adapt = what_if or ("already adapting" if adapting else flags)
    marked = found is not None and looking.tick in found.flagged
    changed = "" if not looking.choice.recorded else "nothing is changed"
    first, last = looking.attempt <= 0, looking.attempt >= attempts - 1
    rows = {
        Press.PREVIOUS: (flags, ""), Press.NEXT: (flags, ""), Press.EARLIER: (nothing, ""), Press.LATER: (nothing, ""),
        Press.ATTEMPT_PREVIOUS: ("the first" if first else "", ""),
        Press.ATTEMPT_NEXT: ("the last" if last else "", ""),
        Press.CORRECT: (correct, "not to blame" if marked else "to blame"),
        Press.CRITIC: (one, ""), Press.RESET: (changed, ""), Press.ADAPT: (adapt, ""),
    }  # fmt: skip
    return {press: Offer(enabled=not why, line=why or hint) for press, (why, hint) in rows.items()}


def mark_offers(judged: Judged | None, cannot_keep: str, note: str) -> dict[Press, Offer]:
    """The words on the attempt on show. `cannot_keep`: "" or why nobody keeps them; `note`: what is written."""
    nobody = cannot_keep or ("it has not ended" if judged is None else "")
    reasons = {press: nobody or _said_already(judged, verdict) for press, verdict in VERDICTS.items()}
    reasons[Press.KEEP_NOTE] = nobody or ("" if note.strip() else "write one first")
    return {press: Offer(enabled=not why, line=why) for press, why in reasons.items()}


def _said_already(judged: Judged | None, verdict: Verdict) -> str:
    return "a person said so" if judged is not None and judged.verdict is verdict else ""
