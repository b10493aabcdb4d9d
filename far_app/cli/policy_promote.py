"""`far policy promote SESSION VERSION --out FILE`: an adapted version as a checkpoint of its own."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from far_app.errors import CheckpointError
from far_app.recording.inspect import find_session
from far_app.recording.reader import SessionRecording, read_session
from far_app.recording.weights_file import find_version, kept_weights


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="far policy promote", description="An adapted version as a checkpoint.")
    parser.add_argument("session", type=Path, help="a recorded session")
    parser.add_argument("version", help="as far policy list names it: base+a1, or 3:base+a1 for trial 3's")
    parser.add_argument("--out", type=Path, required=True, help="the checkpoint to write")
    parser.add_argument("--base", type=Path, help="the policy the session ran with, where it is not where it was")
    parser.add_argument("--overwrite", action="store_true", help="replace what is at --out")
    options = parser.parse_args(list(arguments))
    from far_app.exchange.target import check_target

    session = read_session(find_session(options.session))
    check_target(options.out, options.overwrite)
    kept, problems = kept_weights(session)
    for problem in problems:
        print(f"far: {problem}", file=sys.stderr)
    chosen = find_version(kept, options.version, session.path)
    base = options.base or base_policy(session)
    from far_app.learning.adapted import promote

    promote(chosen, base, options.out)
    from far_app.cli.assemble import shipped

    critic = base.with_name("critic.safetensors") if base != shipped(chosen.task, "policy") else None
    critic = critic or shipped(chosen.task, "critic")
    print(f"{options.out}: far run --task {chosen.task} --policy {options.out} --critic {critic}")
    return 0


def base_policy(session: SessionRecording) -> Path:
    """The checkpoint a session ran with. Raises CheckpointError when its recording names none."""
    from far_app.cli.assemble import shipped

    info = session.header.info
    if info.policy.startswith("shipped: "):
        return shipped(info.task, "policy")
    if not info.policy.endswith(".safetensors"):
        raise CheckpointError(f"{session.path} ran with '{info.policy}', which is no checkpoint; give it with --base")
    return Path(info.policy)
