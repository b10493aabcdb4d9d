"""`far bench loop` on the real driver: the fake controller at the end of the wire, a page that somebody looks at."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.hw.conftest import FAKE_PORT, loopback

FAR = "import sys; from far_app.cli import main; sys.exit(main(sys.argv[1:]))"


@pytest.mark.slow
def test_the_arm_is_led_by_the_policy_in_both_halves_and_learning_goes_on_in_one(tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    words = ["--robot", "xarm", "--fake", f"{loopback()}:{FAKE_PORT}", "--seconds", "50", "--json", str(report)]
    done = subprocess.run(
        [sys.executable, "-c", FAR, "bench", "loop", *words], capture_output=True, text=True, timeout=250, check=False
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(report.read_text())
    assert found["page_client"], "a page that nobody looks at would hold the arm"
    for half in ("idle", "adapting"):
        assert found[half]["ticks"] >= 150, "an attempt, to its horizon"
        assert found[half]["plan_age_ticks"]["p50"] >= 1
    assert found["adapting"]["adaptations"] >= 1
