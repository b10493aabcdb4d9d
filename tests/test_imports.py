"""Who may import whom (design: calls point downward; only the CLI and the benchmarks compose the three packages)."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
CORE = (
    "types", "protocols", "trial", "motion", "aggregation", "config", "wire", "telemetry", "endpoints",
    "session_states", "errors", "tasks", "detectors", "noise", "seeding", "link", "scheduling", "keys", "station",
    "picture", "preflight", "alarm", "device_input", "take_over", "signal_event",
)  # fmt: skip
HEAVY = {"torch", "mujoco", "robosuite", "numba", "cv2", "viser", "rerun", "scipy", "mcap", "h5py", "tyro", "OpenGL"}
COMPOSERS = ("far_app/cli", "far_app/bench")


def modules(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


def imported(path: Path) -> set[str]:
    """Every module a file imports, anywhere in it, as a dotted name."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide the direction"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def uses(path: Path, package: str) -> bool:
    return any(name == package or name.startswith(f"{package}.") for name in imported(path))


@pytest.mark.parametrize("path", modules("hw"), ids=str)
def test_hw_imports_no_torch_no_ui_and_of_far_app_only_its_core(path):
    assert not uses(path, "torch") and not uses(path, "ui") and not uses(path, "rerun") and not uses(path, "viser")
    for name in imported(path):
        if name.startswith("far_app."):
            assert name.split(".")[1] in CORE, f"{path.name} imports {name}"


@pytest.mark.parametrize("path", modules("ui"), ids=str)
def test_ui_imports_no_hw_and_no_torch(path):
    assert not uses(path, "hw") and not uses(path, "torch") and not uses(path, "mujoco")


@pytest.mark.parametrize("path", [p for p in modules("far_app") if not str(p.relative_to(ROOT)).startswith(COMPOSERS)],
                         ids=str)  # fmt: skip
def test_only_the_composers_import_hw_or_ui(path):
    assert not uses(path, "hw") and not uses(path, "ui"), path


@pytest.mark.parametrize("path", modules("far_app"), ids=str)
def test_torch_lives_where_something_learns_or_infers(path):
    where = path.relative_to(ROOT).parts
    if where[1] not in ("learning", "methods", "cli", "bench"):
        assert not uses(path, "torch"), path


@pytest.mark.parametrize("package", ["far_app", "hw", "ui"])
def test_no_pickle_anywhere(package):
    for path in modules(package):
        assert not imported(path) & {"pickle", "cloudpickle", "dill", "shelve"}, path


def loaded_by(statement: str) -> set[str]:
    """Top-level packages in sys.modules of a fresh interpreter after a statement."""
    code = f"import sys; {statement}; print(*sorted({{m.split('.')[0] for m in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    return set(done.stdout.split())


def test_the_core_loads_nothing_heavier_than_numpy():
    statement = "; ".join(f"import far_app.{name}" for name in CORE)
    assert not loaded_by(statement) & HEAVY


def test_the_session_loads_no_torch_no_hw_no_ui():
    assert not loaded_by("import far_app.session.session") & {"torch", "hw", "ui", "viser", "mujoco", "rerun"}


def test_the_hw_server_loads_no_torch_and_the_page_no_hw():
    assert not loaded_by("import hw.server") & {"torch", "ui", "viser"}
    assert not loaded_by("import ui.server") & {"torch", "hw", "mujoco", "robosuite"}
