"""`far mark SESSION TRIAL ATTEMPT success|failure|unsure|note`: a person's word on a recorded attempt, afterwards."""

from __future__ import annotations

import argparse
import getpass
from collections.abc import Sequence
from pathlib import Path

from far_app.marks import Mark, Verdict
from far_app.recording.inspect import find_session
from far_app.recording.judged import mark_closed
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
    verdict = None if options.verdict == "note" else Verdict(options.verdict)
    by = options.by if options.by is not None else getpass.getuser()
    mark = Mark(trial=options.trial, attempt=options.attempt, verdict=verdict, note=options.note, by=by)
    final = mark_closed(read_session(find_session(options.session)), mark).final
    before = "unsure" if final is None else "success" if final else "failure"
    print(f"trial {mark.trial}, attempt {mark.attempt}: {before} → {verdict or before} by {by} {mark.note}".rstrip())
    return 0
