"""View models as HTML fragments: pure, every foreign text escaped. Classes are styled by style.css."""

from __future__ import annotations

import math
from html import escape

import numpy as np

from far_app.telemetry import LogLine, Telemetry, TrialRow
from ui.keys import Page, keys_of
from ui.stop import StopResult
from ui.view_model import AdaptationCard, Banner, Freshness, Gauge, Tone

HISTORY_ROWS = 40
LOG_LINES = 30
PIPS = 24
"""Attempts of a trial that are drawn as a pip each; more than that are told by number alone."""
ONE_COLUMN = 13
"""Keys that fit below each other; more of them stand in two columns."""


def head(banner: Banner, arm: tuple[str, Tone]) -> str:
    """The full-width head: state word, attempt k/N, where we are, progress."""
    pips = "".join(
        f'<i class="{"on" if k < banner.attempt else "now" if k == banner.attempt else ""}"></i>'
        for k in range(1, banner.max_attempts + 1 if banner.max_attempts <= PIPS else 1)
    )
    share = 100 * min(1.0, banner.tick / banner.horizon) if banner.horizon else 0
    arm_text, arm_tone = arm
    attempt = f"{banner.attempt or '–'}<small>/{banner.max_attempts or '–'}</small>"
    tick = f"{banner.tick}<small>/{banner.horizon or '–'}</small>"
    return f"""<div class="far-head tone-{banner.tone}" id="op-state" data-state="{escape(banner.word)}"
 data-attempt="{banner.attempt}" data-tick="{banner.tick}">
<div class="far-word">{escape(banner.word)}</div>
<div class="far-why"><p>{escape(banner.detail)}</p><p class="far-arm tone-{arm_tone}">{escape(arm_text)}</p></div>
<div class="far-fact far-attempt"><span>attempt</span><b>{attempt}</b><em>{pips}</em></div>
<div class="far-fact"><span>trial</span><b>{escape(banner.trial)}</b></div>
<div class="far-fact"><span>scene</span><b>{escape(banner.scene)}</b></div>
<div class="far-fact far-tick"><span>tick</span><b>{tick}</b></div>
<div class="far-fact far-text"><span>policy</span><b>{escape(banner.policy)}</b></div>
<div class="far-fact far-text"><span>method · task</span><b>{escape(banner.method)} · {escape(banner.task)}</b></div>
<div class="far-bar"><u style="width:{share:.1f}%"></u></div>
</div>"""


def beat(seq: int, fresh: Freshness) -> str:
    """The dead man: re-sent twice a second; when re-sending ceases, CSS alone raises the overlay after 2 s.

    While the app is silent it is raised at once, with what is known."""
    silent = fresh.app_silent and fresh.app is not None
    what, hint = "NO LIVE DATA", "This page has lost its server. What you see is old. Use the stop at the arm."
    if silent:
        what, hint = "APP SILENT", "What you see is old. STOP still reaches the arm directly."
    now = " now" if silent else ""
    return (
        f'<div class="far-beat" id="op-beat" data-seq="{seq}"><div class="far-dead{now}" id="op-dead">'
        f"<div><h1>{what}</h1><p>{hint}</p></div></div></div>"
    )


def stop_note(result: StopResult | None, latched: bool, reason: str) -> str:
    """What became of the last STOP."""
    text, tone = "also: space key", Tone.IDLE
    if result is not None and result.latched is None:
        text, tone = "stopping …", Tone.WARN
    elif result is not None and result.latched is False:
        text, tone = "NOT CONFIRMED: the hw server does not answer. Use the stop at the arm!", Tone.BAD
    elif latched:
        took = f" in {result.latency_ms:.0f} ms" if result is not None and math.isfinite(result.latency_ms) else ""
        text, tone = f"latched{took}" if took else f"latched: {reason}" if reason else "latched", Tone.BAD
    return f'<div class="far-stopnote tone-{tone}" id="op-stop">{escape(text)}</div>'


def adaptation(card: AdaptationCard) -> str:
    rows = "".join(f"<tr><th>{escape(a)}</th><td>{escape(b)}</td></tr>" for a, b in card.rows)
    return f"""<div class="far-card far-adapt tone-{card.tone}" id="op-adapt">
<h2>Adaptation <em>{escape(card.word)}</em></h2>
<div class="far-bar"><u style="width:{100 * card.fraction:.0f}%"></u></div><table>{rows}</table></div>"""


def history(rows: tuple[TrialRow, ...], line: str) -> str:
    """Newest first."""
    body = "".join(
        f'<tr class="tone-{Tone.GOOD if r.success else Tone.WARN}"><td>{r.trial}</td><td>{r.scene_seed}</td>'
        f'<td class="far-out">{"solved" if r.success else "not solved"}</td><td>{r.attempts}</td><td>{r.flagged}</td>'
        f"<td>{escape(r.judged_by)}</td><td>{r.seconds:.0f} s</td><td>{escape(r.note)}</td></tr>"
        for r in reversed(rows[-HISTORY_ROWS:])
    )
    if not body:
        body = '<tr><td colspan="8" class="far-empty">The first trial is not over yet.</td></tr>'
    heads = "".join(f"<th>{h}</th>" for h in ("trial", "scene", "outcome", "att.", "flagged", "judge", "time", "note"))
    return f"""<div class="far-card far-history" id="op-history"><h2>Trials <em>{escape(line)}</em></h2>
<div class="far-scroll"><table><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div></div>"""


def events(lines: tuple[LogLine, ...], now: float) -> str:
    """Newest first, with their age."""
    body = "".join(
        f'<p class="far-{escape(line.level)}"><b>{escape(_age(now - line.stamp))}</b>{escape(line.text)}</p>'
        for line in reversed(lines[-LOG_LINES:])
    )
    body = body or '<p class="far-empty">Nothing yet.</p>'
    return f'<div class="far-card far-events" id="op-events"><h2>Events</h2><div class="far-scroll">{body}</div></div>'


def foot(gauges: tuple[Gauge, ...], refusal: str, viewer: str | None, session: str, why: str | None = None) -> str:
    """Loop health along the bottom edge."""
    items = "".join(
        f'<span class="tone-{g.tone}"><i>{escape(g.label)}</i><b>{escape(g.value)}</b></span>' for g in gauges
    )
    link = (
        '<a href="/go/rerun" target="_blank" rel="noreferrer">rerun viewer ↗</a>'
        if viewer
        else '<a class="off">rerun off</a>'
    )
    if why:
        link = '<a href="/go/why" target="_blank" rel="noreferrer">why did it fail ↗</a>' + link
    said = f'<span class="far-refusal">{escape(refusal)}</span>' if refusal else ""
    items = f'{said}<div class="far-gauges">{items}</div><span class="far-session">{escape(session)}</span>{link}'
    return f'<div class="far-foot" id="op-loop">{items}</div>'


def keys(page: Page, shown: bool) -> str:
    """The list on `?`, from the keys table; not shown it is empty."""
    rows = "".join(f"<p><kbd>{escape(k.cap)}</kbd><span>{escape(k.does)}</span></p>" for k in keys_of(page))
    note = "Keys do nothing while a text field has the focus. ? closes this list."
    many = ' class="many"' if len(keys_of(page)) > ONE_COLUMN else ""
    body = f"<div><h2>Keys</h2><section{many}>{rows}</section><footer>{note}</footer></div>" if shown else ""
    return f'<div class="far-keys{" on" if shown else ""}" id="op-keys">{body}</div>'


def caption(title: str, note: str = "", mark: str = "", tone: Tone = Tone.IDLE) -> str:
    """A title above a picture or a plot; `mark` names it for style.css."""
    return f'<div class="far-caption {mark} tone-{tone}"><b>{escape(title)}</b><em>{escape(note)}</em></div>'


def value_caption(telemetry: Telemetry | None) -> str:
    """V now, or what was flagged."""
    values = telemetry.values[np.isfinite(telemetry.values)] if telemetry is not None else np.zeros(0)
    note = f"now {values[-1]:.2f}" if len(values) else "no value yet"
    if telemetry is not None and telemetry.flagged:
        note = f"{len(telemetry.flagged)} flagged chunks shaded red"
    return caption("Value V(s)", note, "mark-value")


def change_caption(telemetry: Telemetry | None) -> str:
    """Known only once an attempt has failed."""
    note = "after a failed attempt"
    if telemetry is not None and len(telemetry.value_changes):
        note = f"{len(telemetry.flagged)} at or below the threshold {telemetry.threshold:.3f}"
    return caption("Value change ΔV per chunk", note, "mark-change")


def _age(seconds: float) -> str:
    if seconds < 1:
        return "now"
    if seconds < 60:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 3600 else f"{seconds / 3600:.1f} h"
