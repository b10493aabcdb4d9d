"""The real ui process against a test source, for the tests that need both."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from ui_process import PageProcess, free_port
from ui_stage import Stage


@pytest.fixture
def folder() -> Iterator[Path]:
    """Short enough for ipc socket names."""
    with TemporaryDirectory(prefix="far") as name:
        yield Path(name)


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def stage(folder: Path) -> Iterator[Stage]:
    source = Stage(folder)
    yield source
    source.close()


@pytest.fixture
def start_page(folder: Path, port: int) -> Iterator[Callable[..., PageProcess]]:
    """Starts the ui process; called again it starts another on the same port."""
    started: list[PageProcess] = []

    def start(*arguments: str) -> PageProcess:
        started.append(PageProcess(folder, port, *arguments))
        return started[-1]

    yield start
    for page in started:
        page.kill()
