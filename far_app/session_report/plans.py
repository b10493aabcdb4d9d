"""A plan of trials in the report: the methods under their names once all of it is done, under their letters before."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from far_app.recording.reader import SessionRecording
from far_app.session_report.outcomes import allowed
from far_app.trial_plan.plan import recorded
from far_app.trial_plan.progress import done_in, recorded_plan
from far_app.trial_plan.shown import PlanShown
from far_app.trial_plan.telling import Teller


@dataclass(frozen=True, kw_only=True)
class Planned:
    """One plan's trials among the sessions of a report."""

    shown: PlanShown
    names: Mapping[str, str]
    """What its methods are to be called where not by their own names: letters of a blinded plan that is not done."""
    left_out: int
    """Trials begun that do not count."""


def plans(sessions: Sequence[SessionRecording], *, unblind: bool = False) -> list[Planned]:
    """Every plan that these sessions ran, as its newest session tells it. `unblind` tells the truth before the end."""
    by_name: dict[str, list[SessionRecording]] = {}
    for session in sessions:
        if (known := recorded_plan(session)) is not None:
            by_name.setdefault(str(known.get("name", "")), []).append(session)
    return [_planned(found, unblind) for found in by_name.values()]


def _planned(sessions: Sequence[SessionRecording], unblind: bool) -> Planned:
    known: Mapping[str, Any] = sessions[-1].header.info.config["plan"]
    plan = recorded(known, blind=bool(known.get("blind")) and not unblind)
    done = done_in(sessions)
    begun = [(s, e) for s in sessions for e in s.log if e.event == "trial_started"]
    attempts = {method.name: 1 for method in plan.methods}
    for session, entry in begun:
        method = str(entry.detail.get("method"))
        if method in attempts:
            attempts[method] = max(attempts[method], allowed(session, entry.trial) or 1)
    teller = Teller(plan=plan, attempts=attempts)
    blinded = teller.blinded(done)
    names = {m.name: teller.label(m.name, blinded=True) for m in plan.methods} if blinded else {}
    return Planned(shown=teller.shown(done), names=names, left_out=len(begun) - len(done))
