"""`far mark SESSION TRIAL ATTEMPT success|failure|unsure|note`: a person's word on a recorded attempt, afterwards."""

from __future__ import annotations

import argparse
import getpass
from collections.abc import Sequence
from pathlib import Path

from far_app.errors import ConfigError
from far_app.marks import Mark, Verdict
from far_app.recording import marks
from far_app.recording.inspect import find_session
from far_app.recording.reader import read_session


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="far mark", description="Your word on a recorded attempt; nothing is erased.")
    parser.add_argument("session", type=Path, help="a recorded session that is over")
    parser.add_argument("trial", type=int)
    parser.add_argument("attempt", type=int)
    parser.add_argument("verdict", choices=[*Verdict, "note"])
    parser.add_argument("--note", default="")
    parser.add_argument("--by", default=None, help="who says so; your login by default")
    options = parser.parse_args(list(arguments))
    session = read_session(find_session(options.session))
    if session.live:
        raise ConfigError(f"{session.path} is still being recorded; mark its attempts on its page")
    key = options.trial, options.attempt
    if key not in session.marks:
        known = ", ".join(f"{t}.{a}" for t, a in session.marks) or "none"
        raise ConfigError(
            f"{session.path} has no ended attempt {key[1]} of trial {key[0]}; it has (trial.attempt) {known}"
        )
    before = "unsure" if key in session.unsure else "success" if session.marks[key].success else "failure"
    verdict = None if options.verdict == "note" else Verdict(options.verdict)
    by = options.by if options.by is not None else getpass.getuser()
    marks.append(
        session.path, Mark(trial=key[0], attempt=key[1], verdict=verdict, note=options.note, by=by)
    )  # fmt: skip
    print(f"trial {key[0]}, attempt {key[1]}: {before} → {verdict or before} by {by} {options.note}".rstrip())
    return 0
