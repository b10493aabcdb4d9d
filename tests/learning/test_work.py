"""What the learning process makes is what would be made here, and nobody is kept waiting by one that is gone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
import torch
from torch import Tensor

from far_app.config import FCPAConfig
from far_app.errors import ConfigError, FarError
from far_app.learning.apart.here import WorkHere
from far_app.learning.apart.process import WorkProcess
from far_app.learning.apart.protocol import Work
from far_app.learning.cancellation import AdaptationCancelledError, Cancelled, never
from far_app.learning.fcpa import Update
from far_app.learning.pairs import Pairs
from far_app.learning.preference import Demonstrations
from far_app.learning.unet import ConditionalUnet1d
from far_app.types import AdaptationStep

S, M, H, A, F = 3, 4, 8, 7, 20
QUICK = FCPAConfig(steps=3, lr=1e-3)


class Apart:
    """A learning process and its work, as the application starts them."""

    def __init__(self, folder: Path) -> None:
        command = [sys.executable, "-m", "far_app.learning.apart.server", "--folder", str(folder), "--threads", "2"]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        self.work = WorkProcess(folder, lambda: None if self.process.poll() is None else "killed", WorkHere())

    def close(self) -> None:
        self.process.terminate()
        assert self.process.wait(10) == 0
        self.work.close()


@pytest.fixture(scope="module")
def apart() -> Iterator[Apart]:
    with TemporaryDirectory(prefix="far") as name:
        there = Apart(Path(name))
        yield there
        there.close()


def denoiser() -> ConditionalUnet1d:
    torch.manual_seed(3)
    return ConditionalUnet1d(A, F, widths=(16, 32)).eval().requires_grad_(False)


def numbers(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def pairs() -> Pairs:
    owner = torch.arange(S).repeat_interleave(2)
    return Pairs(
        features=numbers(0, S, F), negatives=numbers(1, S, H, A), positives=numbers(2, 2 * S, H, A), owner=owner,
        weights=torch.ones(2 * S),
    )  # fmt: skip


def updated(
    work: Work, config: FCPAConfig, cancelled: Cancelled = never
) -> tuple[Update, list[Tensor], list[AdaptationStep]]:
    told: list[AdaptationStep] = []
    copy = denoiser().requires_grad_(True)
    shown = Demonstrations(features=numbers(5, 9, F), chunks=numbers(6, 9, H, A))
    update = work.update(copy, pairs(), config, (7, 2), cancelled, told.append, shown)
    return update, [p.detach() for p in copy.parameters()], told


@pytest.mark.parametrize("guard", ["none", "stop", "bc"])
def test_an_update_is_the_same_to_the_bit(apart, guard):
    config = FCPAConfig(steps=3, lr=1e-3, guard=guard)
    (here, ours, told), (there, theirs, heard) = updated(WorkHere(2), config), updated(apart.work, config)
    assert here == there and there.changed and len(there.history) >= 2
    assert told == heard == list(there.history)
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(theirs, denoiser().parameters(), strict=True))


def test_candidates_are_the_same_to_the_bit(apart):
    asked = denoiser(), 4, numbers(0, S, F), numbers(1, S, M, H, A), never
    here, there = WorkHere(2).candidates(*asked), apart.work.candidates(*asked)
    assert there.shape == (S, M, H, A) and torch.equal(here, there)
    assert apart.work.candidates(denoiser(), 4, numbers(0, 0, F), numbers(1, 0, M, H, A), never).shape[0] == 0


def test_what_nobody_waits_for_is_left_and_the_next_answer_is_the_next_question_s(apart):
    long = FCPAConfig(steps=100_000, lr=1e-9)
    began = time.monotonic()
    with pytest.raises(AdaptationCancelledError):
        updated(apart.work, long, lambda: time.monotonic() > began + 0.5)
    assert updated(apart.work, QUICK)[0] == updated(WorkHere(), QUICK)[0]


def test_an_error_there_is_an_error_here(apart):
    copy = denoiser().requires_grad_(True)
    broken = FCPAConfig(guard="bc")
    with pytest.raises(FarError, match="no demonstrations were given"):
        apart.work.update(copy, pairs(), broken, (0, 0), never, lambda step: None, None)
    with pytest.raises(ConfigError, match="no demonstrations were given"):
        WorkHere().update(copy, pairs(), broken, (0, 0), never, lambda step: None, None)


def test_one_that_dies_fails_its_lesson_and_the_next_is_learnt_here(caplog):
    with TemporaryDirectory(prefix="far") as name:
        there = Apart(Path(name))
        updated(there.work, QUICK)
        timer = threading.Timer(0.5, lambda: os.kill(there.process.pid, signal.SIGKILL))
        timer.start()
        with pytest.raises(FarError, match="ended meanwhile: killed"):
            updated(there.work, FCPAConfig(steps=100_000, lr=1e-9))
        assert updated(there.work, QUICK)[0] == updated(WorkHere(), QUICK)[0]
        assert "learning goes on in this one" in caplog.text
        there.work.close()


def test_it_ends_with_the_application():
    with TemporaryDirectory(prefix="far") as name:
        command = [sys.executable, "-m", "far_app.learning.apart.server", "--folder", name]
        code = f"import subprocess, time; print(subprocess.Popen({command!r}).pid, flush=True); time.sleep(60)"
        parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        time.sleep(2.0)
        parent.kill()
        parent.wait()
        deadline = time.monotonic() + 15
        while time.monotonic() < deadline and Path(f"/proc/{child}/status").exists():
            if "zombie" in Path(f"/proc/{child}/status").read_text():
                break
            time.sleep(0.05)
        else:
            assert not Path(f"/proc/{child}").exists(), "it goes on without its application"
