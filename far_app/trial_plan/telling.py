"""A plan's state as the page, the terminal and the report tell it, blinded where it must be. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from far_app.trial_plan.order import Slot, letters, slots
from far_app.trial_plan.plan import TrialPlan
from far_app.trial_plan.progress import Done, arm, paired
from far_app.trial_plan.shown import PlanShown


@dataclass(frozen=True, kw_only=True)
class Teller:
    plan: TrialPlan
    attempts: Mapping[str, int]
    """A trial's, by method."""

    def blinded(self, done: Done) -> bool:
        """The truth is told when every trial is done, not before."""
        return self.plan.blind and any(slot not in done for slot in slots(self.plan))

    def label(self, method: str, *, blinded: bool) -> str:
        return letters(self.plan)[method] if blinded else method

    def shown(self, done: Done, now: Slot | None = None) -> PlanShown:
        """With `now` the trial under way or about to begin."""
        plan, blinded = self.plan, self.blinded(done)
        names = {m.name: self.label(m.name, blinded=blinded) for m in plan.methods}
        order = sorted(names, key=lambda name: names[name]) if blinded else list(names)
        revealed = plan.blind and not blinded
        return PlanShown(
            name=plan.name, done=sum(slot in done for slot in slots(plan)), total=plan.trials, blind=blinded,
            label=names[now.method] if now else "", scene=now.scene if now else "",
            repetition=now.repetition if now else 0, repetitions=plan.repetitions, precision=plan.precision,
            arms=tuple(arm(name, names[name], done, self.attempts[name]) for name in order),
            differences=tuple(paired(order, names.__getitem__, done, plan.precision)),
            revealed=tuple(sorted((word, name) for name, word in letters(plan).items())) if revealed else (),
        )  # fmt: skip


def lines(shown: PlanShown) -> list[str]:
    """For the terminal."""
    width = max((len(a.label) for a in shown.arms), default=0)
    out = [f"plan {shown.name}: {shown.done} of {shown.total} trials done"]
    for a in shown.arms:
        rates = [
            f"within {k}: {solved}/{a.trials} [{100 * low:.0f}, {100 * high:.0f}] %"
            for k, (solved, low, high) in enumerate(zip(a.solved, a.low, a.high, strict=True), 1)
        ]
        out.append(f"  {a.label:<{width}}  {'   '.join(rates) if a.trials else 'no trial yet'}")
    for d in shown.differences:
        if not d.pairs:
            out.append(f"  {d.left} − {d.right}: no scene done under both yet")
            continue
        span = f"[{100 * d.low:+.0f}, {100 * d.high:+.0f}]" if d.high > d.low and d.pairs > 1 else "–"
        out.append(
            f"  {d.left} − {d.right}: {100 * d.mean:+.0f} points {span} on {d.pairs} pairs, "
            f"only {d.left} {d.only_left}, "
            f"only {d.right} {d.only_right}, McNemar p = {d.p:.3g}; {to_go(d.left_to_go, shown.precision)}"
        )
    out += [f"  {letter} is {name}" for letter, name in shown.revealed]
    return out


def to_go(trials: int | None, precision: float) -> str:
    """How far the interval is from what is wished for."""
    if trials is None:
        return f"± {precision:g} points: not known before the first pair"
    return f"about {trials} trials to ± {precision:g} points" if trials else f"within ± {precision:g} points"
