"""`far inspect PATH [--json]`: what a recorded session holds, and what is missing or damaged."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from far_app.recording.inspect import inspect_command


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="far inspect", description="What a recorded session holds.")
    parser.add_argument("path", type=Path, nargs="?", default=Path("recordings"), help="a session, or a folder of them")
    parser.add_argument("--json", action="store_true", help="as JSON, for programs")
    options = parser.parse_args(list(arguments))
    text, status = inspect_command(options.path, options.json)
    print(text)
    return status
