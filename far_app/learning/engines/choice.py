"""Which engine is fastest here: each that runs the policy by itself plans a few chunks, once for a machine.

What was found is kept in `engines.json` in the user's cache folder, under all it depends on: processor, versions,
architecture, threads. Programs that start together measure one after the other, so that they come to the same choice.
Called for a run; comparisons in lockstep take the order of ENGINES, which no measurement can change.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import importlib.metadata
import json
import logging
import os
import platform
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from far_app.errors import FarError
from far_app.learning.engines import ENGINES, Choice, order_of
from far_app.learning.engines.protocol import Engine
from far_app.learning.engines.taking import probe
from far_app.learning.policy import DiffusionPolicy

log = logging.getLogger(__name__)

WARM_UP, REPEATS = 2, 9
"""Chunks planned before and during a measurement."""


def cache_file() -> Path:
    """Where measurements are kept; $XDG_CACHE_HOME is heeded."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "far" / "engines.json"


def fastest(network: DiffusionPolicy, threads: int = 1, file: Path | None = None) -> Choice:
    """What "auto" stands for in a run: the engines that can run this network, the fastest here first. `threads`: of one
    torch operation, as the run will have them. Where measurements cannot be kept: the order of ENGINES."""
    usable, file = order_of("auto", network), file or cache_file()
    if len(usable.order) < 2:
        return usable
    key = fingerprint_of(network, usable.order, threads)
    try:
        with locked(file):
            known = _read(file)
            if key not in known:
                known[key] = measured(network, usable.order, threads)
                partial = file.with_suffix(".partial")
                partial.write_text(json.dumps(known, indent=1) + "\n")
                partial.replace(file)
    except OSError as error:
        log.warning("engines are not measured, for %s cannot be kept: %s", file, error)
        return usable
    found: dict[str, float] = {n: ms for n, ms in known[key].items() if n in usable.order}
    order = tuple(sorted(found, key=found.__getitem__))
    if not order:
        return usable
    told = ", ".join(f"{name} {found[name]:.1f}" for name in order)
    return Choice(order=(*order, *(n for n in usable.order if n not in found)), why=f"fastest here, ms a chunk: {told}")


def measured(network: DiffusionPolicy, names: tuple[str, ...], threads: int) -> dict[str, float]:
    """Median milliseconds of a chunk from new observations, by engine; those that cannot be built are left out."""
    engines: dict[str, Engine] = {}
    for name in names:
        try:
            engines[name] = ENGINES[name].make(network, "measured", False)
        except (FarError, RuntimeError) as error:
            log.warning("engine %s is not measured: %s", name, error)
    with torch_threads(threads):
        return {name: round(float(np.median(ms)), 3) for name, ms in taking_turns(engines, network).items()}


def taking_turns(engines: Mapping[str, Engine], network: DiffusionPolicy) -> dict[str, list[float]]:
    """Milliseconds of each chunk; whatever else the machine does falls on all engines alike."""
    spent: dict[str, list[float]] = {name: [] for name in engines}
    for _ in range(WARM_UP + REPEATS):
        for name, engine in engines.items():
            histories, noise = probe(network, 1)
            began = time.perf_counter()
            engine.plan(histories, noise)[1].cpu()
            spent[name].append((time.perf_counter() - began) * 1e3)
    return {name: ms[WARM_UP:] for name, ms in spent.items()}


def fingerprint_of(network: DiffusionPolicy, names: tuple[str, ...], threads: int) -> str:
    """Of all that a measurement depends on."""
    device = network.normalizer.low.device
    what: dict[str, Any] = {
        "processor": _processor(), "cores": os.cpu_count(), "torch": torch.__version__, "threads": threads,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu", "engines": names,
        "openvino": importlib.metadata.version("openvino") if "openvino" in names else "", "network": repr(network),
        "config": {k: v for k, v in vars(network.config).items() if k not in ("task", "preset")},
    }  # fmt: skip
    return hashlib.sha256(json.dumps(what, sort_keys=True, default=str).encode()).hexdigest()[:16]


@contextlib.contextmanager
def locked(file: Path) -> Iterator[None]:
    """One program at a time. Raises OSError where the folder cannot be written."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """So many threads of one torch operation for a while."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _read(file: Path) -> dict[str, dict[str, float]]:
    """What is known; nothing where the file is not there or damaged, for it can be measured again."""
    try:
        return dict(json.loads(file.read_text()))
    except (FileNotFoundError, ValueError):
        return {}


def _processor() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor()
