"""`far policy list SESSION`: the policy versions a session made, what each came from, and how its retry went."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from far_app.recording.inspect import find_session
from far_app.recording.reader import SessionRecording, read_session
from far_app.recording.weights_file import Kept, kept_weights


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="far policy list", description="The policy versions a session kept.")
    parser.add_argument("session", type=Path, help="a recorded session")
    options = parser.parse_args(list(arguments))
    session = read_session(find_session(options.session))
    kept, problems = kept_weights(session)
    print("\n".join([*lines(session, kept), *(f"! {problem}" for problem in problems)]))
    return 0


def lines(session: SessionRecording, kept: Sequence[Kept]) -> list[str]:
    """A table with a line for each version."""
    adapted = [e for e in session.log if e.event == "adapted" and e.detail["version"] != e.detail["base_version"]]
    head = f"{session.header.session}   base policy: {session.header.info.policy}"
    if not kept:
        why = f"; {len(adapted)} adaptations were made, but their weights were not kept" if adapted else ""
        return [head, f"no adapted version is kept{why}"]
    size = sum(k.size for k in kept)
    table = [
        f"{'version':<16} {'from':<12} {'learnt from':<20} {'pairs':>5} {'l⁺':>15} {'l⁻':>15}  {'status':<8} "
        f"{'retry':<8} {'MB':>5}"
    ]
    for k in kept:
        table.append(
            f"{f'{k.trial}:{k.version}':<16} {k.parent:<12} {f'trial {k.trial}, attempt {k.attempt}':<20} "
            f"{k.pairs:>5} {change(k.winner_error):>15} {change(k.loser_error):>15}  {k.status:<8} "
            f"{retry(session, k):<8} {k.size / 1e6:>5.1f}"
        )
    said = [f"{e.wall[:19]}  {e.text} ({e.detail.get('by') or 'the operator'})" for e in session.log
            if e.event in ("policy_undone", "policy_restored", "policy_kept")]  # fmt: skip
    end = f"{len(kept)} versions, {size / 1e6:.1f} MB; far policy promote {session.path} VERSION --out FILE keeps one"
    return [head, "", *table, "", *said, *[""] * bool(said), end]


def change(error: tuple[float, float]) -> str:
    return f"{error[0]:.4g} → {error[1]:.4g}"


def retry(session: SessionRecording, kept: Kept) -> str:
    """How the attempt went that this version acted in."""
    outcome = session.marks.get((kept.trial, kept.attempt + 1))
    return "none" if outcome is None else "success" if outcome.success else "failure"
