"""Recorded sessions as one HTML page. Attempts are read one at a time; only their small pictures are kept."""

from __future__ import annotations

import html
import io
from base64 import b64encode
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from far_app.config import AttributionConfig, from_table
from far_app.errors import ConfigError, RecordingError
from far_app.recording.attempt_reader import read_attempt
from far_app.recording.reader import SessionRecording, read_session
from far_app.session_report.failures import card
from far_app.session_report.outcomes import Group, by_attempt, differences, groups, labels
from far_app.session_report.plans import Planned, plans
from far_app.trial_plan.telling import to_go

STYLE = """
:root { color-scheme: light; --ink: #17202a; --dim: #5d6d7e; --line: #d9e0e6; --bad: #d62728; --brand: #1f6fb2; }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); max-width: 1080px; margin: 2rem auto; padding: 0 1rem; }
h1, h2, h3 { line-height: 1.2; } h3 { margin: 0 0 .3rem; } p { margin: .2rem 0; } .dim { color: var(--dim); }
table { border-collapse: collapse; margin: .6rem 0; } th, td { padding: .3rem .8rem;
  border-bottom: 1px solid var(--line); text-align: right; font-variant-numeric: tabular-nums; }
th:first-child, td:first-child { text-align: left; }
article { border: 1px solid var(--line); border-left: 4px solid var(--bad); border-radius: 6px; padding: .8rem 1rem;
  margin: .8rem 0; break-inside: avoid; } .row, .frames { display: flex; flex-wrap: wrap; gap: .8rem; }
figure { margin: .4rem 0 0; } figure img { height: 132px; image-rendering: pixelated; border-radius: 4px;
  margin-right: 4px; } figcaption { font-size: .85rem; color: var(--dim); }
svg { width: 460px; max-width: 100%; align-self: center; background: #f7f9fb; border-radius: 4px; }
svg polyline { fill: none; stroke: var(--brand); stroke-width: 1.6; } svg text { font-size: 11px; fill: var(--dim); }
.flagged { fill: var(--bad); opacity: .12; } .worst { fill: var(--bad); opacity: .4; } img.plot { max-width: 100%; }
"""


def page(paths: Sequence[Path], *, unblind: bool = False) -> str:
    """The page of these sessions; `unblind` names the methods of a blinded plan that is not done. Raises RecordingError
    for a folder that holds none, or one of another schema."""
    sessions = [read_session(path) for path in paths]
    planned = plans(sessions, unblind=unblind)
    found = groups(sessions, {method: letter for plan in planned for method, letter in plan.names.items()})
    title = f"{sessions[0].header.session}" if len(sessions) == 1 else f"{len(sessions)} sessions"
    cards: list[str] = []
    timing: list[str] = []
    problems: list[str] = []
    for session in sessions:
        problems += [f"{session.header.session}: {problem}" for problem in session.problems]
        own = list(_attempts(session, cards, problems))
        timing.append(_timing(session, own))
    trouble = f"<h2>Missing or damaged</h2><ul>{''.join(f'<li>{html.escape(p)}</li>' for p in problems)}</ul>"
    return "\n".join([
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head><body>',
        f"<h1>{html.escape(title)}</h1>{_sessions(sessions)}",
        *(_plan(plan) for plan in planned),
        f"<h2>Success by attempt</h2>{_success(found)}{_plot(found)}",
        f"<h2>Paired differences</h2>{_differences(found)}",
        f"<h2>Timing</h2>{_table(['session', 'ticks', 'lateness p50', 'p99', 'max, ms', 'starved'], timing)}",
        f"<h2>Failures</h2>{''.join(cards) or '<p>No attempt failed.</p>'}",
        trouble if problems else "", "</body></html>",
    ])  # fmt: skip


def _attempts(session: SessionRecording, cards: list[str], problems: list[str]) -> Iterator[tuple[np.ndarray, int]]:
    """Lateness in ms and starved ticks of each attempt; a card for each failure on the way."""
    config = attribution(session)
    for file in session.files:
        trial, attempt = file.parent.name.removeprefix("trial_").lstrip("0"), file.stem.removeprefix("attempt_")
        name = f"{session.header.session}, trial {trial}, attempt {attempt}"
        try:
            recording = read_attempt(file)
            header = recording.header
            outcome = recording.outcome
            if header is not None:
                outcome = session.marks.get((header.trial, header.attempt), outcome)
            if recording.steps and outcome is not None and not outcome.success:
                cards.append(card(recording, outcome, config, name))
            problems.extend(f"{name}: {problem}" for problem in recording.problems)
            late = np.array([1e3 * step.lateness for step in recording.steps])
            yield late[np.isfinite(late)], sum(step.starved for step in recording.steps)
        except RecordingError as error:
            problems.append(f"{name}: {error}")


def attribution(session: SessionRecording) -> AttributionConfig:
    """The session's own rule; the usual one where its recording does not say."""
    known: Any = session.header.info.config
    try:
        raw = dict(known["run"]["retry"]["attribution"])
        return from_table(AttributionConfig, {k: v for k, v in raw.items() if v is not None}, "attribution")
    except (KeyError, TypeError, ConfigError):
        return AttributionConfig()


def _sessions(sessions: Sequence[SessionRecording]) -> str:
    rows = []
    for session in sessions:
        header, info = session.header, session.header.info
        trials = sum(entry.event == "trial_started" for entry in session.log)
        rows.append([header.session, info.task, info.method, info.policy, header.started[:19], str(trials)])
    return _table(["session", "task", "method", "policy", "started", "trials"], [_row(row) for row in rows])


def _plan(plan: Planned) -> str:
    """Each method within its own attempts, on the scenes that both have."""
    shown = plan.shown
    state = f"{shown.done} of {shown.total} trials done, {plan.left_out} begun and left out"
    if shown.blind:
        state += "; blinded: the methods are told by letters until all are done (--unblind tells them now)"
    rows = [
        _row([d.left + " − " + d.right, str(d.pairs), f"{100 * d.mean:+.0f}",
              f"[{100 * d.low:+.0f}, {100 * d.high:+.0f}]" if d.high > d.low and d.pairs > 1 else "–",
              str(d.only_left), str(d.only_right), f"{d.p:.3g}", to_go(d.left_to_go, shown.precision)])
        for d in shown.differences
    ]  # fmt: skip
    head = ["all attempts", "pairs", "points", "95 %", "only left", "only right", "McNemar p", "precision"]
    letters = ", ".join(f"{letter} was {name}" for letter, name in shown.revealed)
    rates = [
        _row([a.label, str(a.trials), f"{a.solved[-1]}/{a.trials}: {100 * a.solved[-1] / a.trials:.0f} % "
              f"[{100 * a.low[-1]:.0f}, {100 * a.high[-1]:.0f}]" if a.trials else "–"])
        for a in shown.arms
    ]  # fmt: skip
    return (
        f"<h2>The plan {html.escape(shown.name)}</h2><p>{html.escape(state)}.</p>"
        f"{_table(['method', 'trials', 'solved'], rates)}{_table(head, rows)}"
        f'<p class="dim">Pairs are trials of the same scene and repetition. {html.escape(letters)}</p>'
    )


def _success(found: Sequence[Group]) -> str:
    last = max(group.max_attempts for group in found)
    rows = []
    for name, group in zip(labels(found), found, strict=True):
        cells = [name, str(len(group.trials)), str(group.unfinished)]
        for rate in by_attempt(group):
            low, high = (100 * bound for bound in rate.interval)
            share = f": {100 * rate.solved / rate.trials:.0f} % [{low:.0f}, {high:.0f}]" if rate.trials else ""
            cells.append(f"{rate.solved}/{rate.trials}{share}")
        cells += [""] * (last - group.max_attempts)
        attempts = [trial.attempts for trial in group.trials]
        rows.append(_row([*cells, f"{np.mean(attempts):.2f}" if attempts else "–"]))
    head = ["method", "trials", "left out", *(f"within {k}" for k in range(1, last + 1)), "attempts a trial"]
    note = (
        "Brackets: 95 % Wilson intervals. Left out, and in no figure: trials skipped, cut off, begun at reduced speed, "
        "helped by a person."
    )
    return f'{_table(head, rows)}<p class="dim">{note}</p>'


def _differences(found: Sequence[Group]) -> str:
    rows = [
        _row([f"{d.left} − {d.right}", str(d.scenes), f"{100 * d.mean:+.0f}",
              f"[{100 * d.low:+.0f}, {100 * d.high:+.0f}]" if d.high > d.low else "–",
              str(d.only_left), str(d.only_right), f"{d.p:.3g}"])
        for d in differences(found)
    ]  # fmt: skip
    head = ["on the same scenes", "scenes", "points", "95 %", "only left", "only right", "McNemar p"]
    note = '<p class="dim">Left minus right, scene by scene; no interval where all scenes agree.</p>'
    return _table(head, rows) + note if rows else "<p>No two methods share a scene.</p>"


def _timing(session: SessionRecording, attempts: Sequence[tuple[np.ndarray, int]]) -> str:
    late = np.concatenate([late for late, _ in attempts]) if attempts else np.zeros(0)
    figures = [f"{np.percentile(late, q):.2f}" for q in (50, 99, 100)] if len(late) else ["–"] * 3
    return _row([session.header.session, str(len(late)), *figures, str(sum(starved for _, starved in attempts))])


def _plot(found: Sequence[Group]) -> str:
    """Success by attempt with its intervals, as a picture within the page."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    shown = [(name, group) for name, group in zip(labels(found), found, strict=True) if group.trials]
    if not shown:
        return ""
    figure, axis = plt.subplots(figsize=(7.2, 3.4), layout="constrained")
    for number, (name, group) in enumerate(shown):
        rates = by_attempt(group)
        share = np.array([rate.solved / rate.trials for rate in rates])
        bounds = np.array([rate.interval for rate in rates]).T
        at = np.arange(1, len(rates) + 1) + 0.06 * (number - (len(shown) - 1) / 2)
        axis.errorbar(at, 100 * share, yerr=100 * np.abs(bounds - share), marker="o", ms=4, elinewidth=0.8, label=name)
    axis.set(xlabel="within so many attempts", ylabel="success, per cent", ylim=(0, 103))
    axis.set_xticks(range(1, max(group.max_attempts for _, group in shown) + 1))
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, fontsize=9)
    raw = io.BytesIO()
    figure.savefig(raw, dpi=110, format="png")
    plt.close(figure)
    return (
        f'<img class="plot" alt="success by attempt" src="data:image/png;base64,{b64encode(raw.getvalue()).decode()}">'
    )


def _row(cells: Sequence[str]) -> str:
    return "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells) + "</tr>"


def _table(head: Sequence[str], rows: Sequence[str]) -> str:
    return "<table><tr>" + "".join(f"<th>{cell}</th>" for cell in head) + f"</tr>{''.join(rows)}</table>"
