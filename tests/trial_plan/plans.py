"""Plans for tests."""

from __future__ import annotations

from pathlib import Path

from far_app.trial_plan.plan import PlannedMethod, TrialPlan, seeded
from far_app.trial_plan.read import read_plan

METHODS = ("dp", "nr", "far")

TWO = """
[[method]]
name = "ours"
method = "far"
[[method]]
name = "theirs"
method = "nr"
"""


def plan(**changes) -> TrialPlan:
    """Two methods on three scenes."""
    usual = {
        "file": Path("ab.toml"), "name": "ab", "task": "lift", "robot": "twin", "scenes": seeded((7, 8, 9)),
        "methods": (PlannedMethod(name="ours", method="far"), PlannedMethod(name="theirs", method="nr")),
    }  # fmt: skip
    return TrialPlan(**(usual | changes))


def read(folder: Path, text: str, robot: str = "twin", cameras: tuple[str, ...] = ()) -> TrialPlan:
    file = folder / "ab.toml"
    file.write_text(text)
    return read_plan(file, robot=robot, cameras=cameras, methods=METHODS)
