"""docs/safety.md promises; what it names as proof must be there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
ROWS = [
    line for line in (ROOT / "docs/safety.md").read_text().splitlines() if line.startswith("|") and "---" not in line
][1:]


def test_each_guarantee_names_where_it_is_done_and_a_test_that_is_there() -> None:
    assert len(ROWS) > 20
    for row in ROWS:
        promise, where, proof = (cell.strip() for cell in row.strip("|").split(" | "))
        assert all((ROOT / path).is_file() for path in re.findall(r"`(.*?)`", where)), where
        tests = re.findall(r"`(tests/\S+\.py)::(test_\w+)`", proof)
        assert tests, f"nothing proves: {promise}"
        for path, name in tests:
            functions = {
                n.name for n in ast.walk(ast.parse((ROOT / path).read_text())) if isinstance(n, ast.FunctionDef)
            }
            assert name in functions, f"{path} has no {name}"
