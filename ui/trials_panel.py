"""The plan of trials on the operator page: how far it is, success by attempt with intervals, paired differences.

The card is there only while a plan runs. Pure HTML but for the class that holds it; look and place are trials.css's.
"""

from __future__ import annotations

from html import escape
from pathlib import Path

import viser

from far_app.telemetry import Telemetry
from far_app.trial_plan.shown import ArmShown, DifferenceShown, PlanShown
from far_app.trial_plan.telling import to_go

_STYLE = (Path(__file__).parent / "trials.css").read_text(encoding="utf-8")
ARMS, PAIRS = 4, 3
"""Rows that fit; more of them are in the report."""


class TrialsPanel:
    """Its widgets on the console; `show` is called from the page's thread."""

    def __init__(self, gui: viser.GuiApi) -> None:
        gui.add_html(f"<style>{_STYLE}</style>")
        self._card = gui.add_html("", visible=False)

    def show(self, telemetry: Telemetry | None) -> None:
        plan = telemetry.plan if telemetry is not None else None
        self._card.visible = plan is not None
        if plan is not None:
            self._card.content = card(plan)


def card(plan: PlanShown) -> str:
    most = max((len(a.solved) for a in plan.arms), default=1)
    heads = "".join(f"<th>within {k}</th>" for k in range(1, most + 1))
    rows = "".join(_arm(a, most, plan.label) for a in plan.arms[:ARMS])
    lines = "".join(f"<p>{_difference(d, plan.precision)}</p>" for d in plan.differences[:PAIRS])
    hidden = " · blinded" if plan.blind else ""
    if plan.revealed:
        lines += f"<p>{escape(' · '.join(f'{letter} is {name}' for letter, name in plan.revealed))}</p>"
    return (
        f'<div class="far-card far-plan" id="op-plan" data-done="{plan.done}" data-total="{plan.total}">'
        f"<h2>Plan {escape(plan.name)} <em>{plan.done} of {plan.total} trials{hidden}</em>{_now(plan)}</h2>"
        f'<div class="far-bar"><u style="width:{100 * plan.done / max(1, plan.total):.1f}%"></u></div>'
        f"<table><thead><tr><th></th><th>trials</th>{heads}<th>95 % interval, all attempts</th></tr></thead>"
        f"<tbody>{rows}</tbody></table>{lines}</div>"
    )


def _now(plan: PlanShown) -> str:
    """The trial under way or about to begin."""
    if not plan.label:
        return ""
    again = f", {plan.repetition} of {plan.repetitions}" if plan.repetitions > 1 else ""
    return f'<span class="far-planned" id="op-planned"><b>{escape(plan.label)}</b>{escape(plan.scene)}{again}</span>'


def _arm(arm: ArmShown, most: int, now: str) -> str:
    cells = "".join(f"<td>{solved}/{arm.trials}</td>" for solved in arm.solved) if arm.trials else "<td>–</td>"
    cells += "<td></td>" * (most - (len(arm.solved) if arm.trials else 1))
    bar = "<td>no trial yet</td>"
    if arm.trials:
        low, high, rate = 100 * arm.low[-1], 100 * arm.high[-1], 100 * arm.solved[-1] / arm.trials
        bar = (
            f'<td class="far-wilson"><span><u style="left:{low:.1f}%;width:{high - low:.1f}%"></u>'
            f'<i style="left:{rate:.1f}%"></i></span>{rate:.0f} % [{low:.0f}, {high:.0f}]</td>'
        )
    mark = ' class="now"' if arm.label == now else ""
    return f"<tr{mark}><th>{escape(arm.label)}</th><td>{arm.trials}</td>{cells}{bar}</tr>"


def _difference(d: DifferenceShown, precision: float) -> str:
    name = f"<b>{escape(d.left)} − {escape(d.right)}</b>"
    if not d.pairs:
        return f"{name} no scene done under both yet"
    span = f" [{100 * d.low:+.0f}, {100 * d.high:+.0f}]" if d.high > d.low and d.pairs > 1 else ""
    only = f"only {escape(d.left)} {d.only_left}, only {escape(d.right)} {d.only_right}"
    pairs = "1 pair" if d.pairs == 1 else f"{d.pairs} pairs"
    return (
        f"{name} {100 * d.mean:+.0f} points{span} on {pairs} · {only} · McNemar p = {d.p:.2g} · "
        f"{escape(to_go(d.left_to_go, precision))}"
    )
