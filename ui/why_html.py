"""The attempt view's words and tables as HTML: pure, every foreign text escaped."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from html import escape

import cv2
import numpy as np
from jaxtyping import UInt8

from far_app.marks import Judged
from far_app.types import Contrast
from far_app.what_if import Answer
from ui import why_svg
from ui.why_model import Attribution, Case, q_colors

_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 92]
_TONE = {"failure": "bad", "success": "good", "cut off": "warn", "unsure": "learn"}


def head(
    case: Case | None, found: Attribution | None, tick: int, attempt: int, attempts: int, why_not: str,
    judged: Judged | None = None,
) -> str:  # fmt: skip
    """Outcome by the last word, which attempt, what is flagged, where one looks."""
    if case is None or found is None:
        word, tone, line, below = "UNREADABLE", "warn", why_not, ""
    else:
        outcome = judged.verdict.value if judged is not None and judged.verdict is not None else case.outcome
        word, tone = outcome.upper(), _TONE[outcome]
        marked = f"marked by {judged.by or 'a person'}" if judged is not None and judged.verdict is not None else ""
        n = len(found.flagged)
        line = f"{n} chunk{'s' if n != 1 else ''} flagged · {found.source}"
        policy = f"policy {case.version}" if case.version else ""
        below = " · ".join(part for part in (marked, policy, case.lesson) if part)
    flagged = found.flagged if found is not None else ()
    place = f"{flagged.index(tick) + 1}" if tick in flagged else "–"
    name = case.name if case is not None else "attempt"
    last = case.length - 1 if case is not None else 0
    share = 100 * tick / last if last > 0 else 0
    return f"""<div class="far-head far-whyhead tone-{tone}" id="why-state" data-outcome="{escape(word)}"
 data-tick="{tick}" data-attempt="{attempt}" data-flagged="{len(flagged)}" data-place="{place}">
<div class="far-word">{escape(word)}</div>
<div class="far-why"><p>{escape(line)}</p><p class="far-arm tone-idle">{escape(below)}</p></div>
<div class="far-fact far-text"><span>attempt {attempt + 1} of {attempts}</span><b>{escape(name)}</b></div>
<div class="far-fact"><span>flagged chunk</span><b>{place}<small>/{len(flagged)}</small></b></div>
<div class="far-fact far-tick"><span>tick</span><b>{tick}<small>/{last}</small></b></div>
<div class="far-bar"><u style="width:{share:.1f}%"></u></div></div>"""


def frames(case: Case | None, tick: int, horizon: int, flagged: bool) -> str:
    """Every camera at s_t and s_{t+H}, side by side."""
    cameras = case.cameras()[:2] if case is not None else ()
    cells = []
    for camera in cameras:
        for when, t in (("t", tick), ("t+H", tick + horizon)):
            assert case is not None
            image = case.frame(t, camera)
            there = f'<img src="{_source(image)}" alt="">' if image is not None else "<i>no frame here</i>"
            cells.append(
                f'<figure class="{"flagged" if flagged else ""}" data-camera="{escape(camera)}" data-tick="{t}">{there}'
                f"<figcaption><b>{escape(camera)}</b> {when} = {t}</figcaption></figure>"
            )
    return f'<div class="why-frames" id="why-frames">{"".join(cells) or "<p>no camera was recorded</p>"}</div>'


def _source(image: UInt8[np.ndarray, "H W 3"]) -> str:
    jpeg = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), _JPEG)[1].tobytes()
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode('ascii')}"


def charts(found: Attribution | None, tick: int) -> str:
    """V and ΔV, one above the other."""
    if found is None or len(found.values) < 2:
        return '<div class="why-charts" id="why-charts"><p>no step to draw</p></div>'
    v, dv = why_svg.value_chart(found, tick), why_svg.change_chart(found, tick)
    now = f"{found.values[tick]:.2f}" if 0 <= tick < len(found.values) and math.isfinite(found.values[tick]) else "–"
    threshold = f"{found.threshold:.2f}" if math.isfinite(found.threshold) else "–"
    return f"""<div class="why-charts" id="why-charts"><h3><b>V(s)</b> {now} at t <em>flagged chunks red</em></h3>{v}
<h3><b>ΔV per chunk</b> flagged at or below <em class="red">{threshold}</em></h3>{dv}</div>"""


def numbers(case: Case | None, found: Attribution | None, tick: int, note: str) -> str:
    """ΔV, its rank, Q of the chunk that was sent, and of each positive Q and d."""
    if case is None or found is None:
        return '<div class="far-card why-numbers" id="why-numbers"></div>'
    place, of = found.rank(tick)
    flagged = tick in found.flagged
    word = found.words.get(tick)
    title = "FLAGGED" if flagged else "not flagged"
    by = ""
    if word is not None:
        said = f"by {word.by or '?'}, {word.wall[:16].replace('T', ' ')}"
        by = f' <em class="word">{escape(said)}</em>'
    change = f"{found.changes[tick]:+.2f}" if place else "unknown"
    contrast = case.contrasts.get(tick)
    rank = f"drop {place} of {of}" if place else "no whole chunk, or V is missing"
    tone = "bad" if flagged else "idle"
    return f"""<div class="far-card why-numbers tone-{tone}" id="why-numbers" data-flagged="{int(flagged)}">
<h2>Chunk {tick} – {tick + found.horizon - 1} <em>{title}</em>{by}</h2>
<p class="why-big"><b>ΔV {change}</b> <span>{rank}</span></p>{_positives(contrast, note)}</div>"""


def _positives(contrast: Contrast | None, note: str) -> str:
    if contrast is None:
        return f'<p class="why-note">{escape(note or "no better chunks are recorded for this one")}</p>'
    colors = q_colors(contrast.q, contrast.negative_q)
    rows = "".join(
        f'<tr><td><i style="background:rgb({r},{g},{b})"></i>{k}</td><td>{q:.2f}</td>'
        f"<td>{q - contrast.negative_q:+.2f}</td><td>{d:.2f}</td></tr>"
        for k, ((r, g, b), q, d) in enumerate(zip(colors, contrast.q, contrast.distance, strict=True), start=1)
    )
    more = f'<p class="why-note">{escape(note)}</p>' if note else ""
    return f"""<table><thead><tr><th>better chunk</th><th>Q</th><th>gain</th><th>d</th></tr></thead><tbody>
<tr class="sent"><td><i style="background:#e0202c"></i>sent</td>
<td>{contrast.negative_q:.2f}</td><td>–</td><td>0</td></tr>
{rows}</tbody></table>{more}"""


def key() -> str:
    """What the colours of the 3D view mean."""
    kinds = (
        ("#ff3c40", "sent"), ("linear-gradient(90deg, rgb(235,150,0), rgb(0,190,90))", "better, by Q"),
        ("#6e7a88", "sampled before"), ("#a050ff", "after adapting"),
        ("#486280", "the hand's way"), ("#d6a03c", "objects"),
    )  # fmt: skip
    parts = "".join(f'<span><i style="background:{color}"></i>{escape(word)}</span>' for color, word in kinds)
    return f'<div class="why-key">{parts}</div>'


def lesson(answer: Answer | None, moved: str) -> str:
    """Adapt again: l⁺ and l⁻ over the steps, and how far sampled chunks moved."""
    if answer is None:
        body = '<p class="why-note long">Shows how the lesson changes the policy: l⁺, l⁻ and sampled paths.</p>'
        return f'<div class="far-card why-lesson" id="why-lesson"><h2>Adapt again</h2>{body}</div>'
    state = answer.error or answer.stage or "done"
    history = answer.history
    chart = why_svg.lesson_chart(history) if history else ""
    legend = ""
    if history:
        a, b = history[0], history[-1]
        good, bad = _percent(a.winner_error, b.winner_error), _percent(a.loser_error, b.loser_error)
        legend = (
            f'<p class="why-legend"><b class="green">l⁺ {b.winner_error:.3f}</b> {good}'
            f' &nbsp; <b class="red">l⁻ {b.loser_error:.3f}</b> {bad}</p>'
        )
    rest = " · ".join(part for part in (moved, answer.note) if part)
    marks = f'data-steps="{len(history)}" data-stage="{escape(answer.stage)}"'
    return f"""<div class="far-card why-lesson" id="why-lesson" {marks}>
<h2>Adapt again <em>{escape(state)}</em></h2>{legend}{chart}<p class="why-note">{escape(rest)}</p></div>"""


def _percent(first: float, last: float) -> str:
    return f"{100 * (last / first - 1):+.1f} %" if first else ""


def foot(session: str, problems: Sequence[str], said: str, link: str) -> str:
    """What is missing in the recording, in words; what went wrong."""
    missing = " · ".join(problems)
    text = f'<span class="why-missing" id="why-missing">{escape(missing)}</span>' if missing else ""
    wrong = f'<span class="far-refusal" id="why-said">{escape(said)}</span>' if said else ""
    return (
        f'<div class="far-foot">{wrong}{text}<span class="far-session">{escape(session)}</span>'
        f'<span class="why-link">{escape(link)}</span></div>'
    )
