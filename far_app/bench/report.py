"""A benchmark's report: to the terminal always, to a file on request."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def write(report: dict[str, Any], path: Path | None) -> None:
    text = json.dumps(report, indent=2)
    print(text, flush=True)
    keep(report, path)


def keep(report: dict[str, Any], path: Path | None) -> None:
    """What is known so far, should the rest never come."""
    if path is not None:
        path.write_text(json.dumps(report, indent=2) + "\n")
