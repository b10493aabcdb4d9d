"""Workers on a Ray cluster: the same scenes in blocks, the same records. A worker that dies is replaced, and
the rest of its block goes to the next one; what it had told is kept, so nothing is lost or counted twice.

Ray is an optional extra. Checkpoints must lie at the same paths on every machine.
"""

from __future__ import annotations

import os
import socket
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from far_app.errors import ConfigError, FarError
from far_app.workers import Begin, Job, Record, Work, Workers

BLOCK = 16
"""Scenes a worker takes at a time; fewer towards the end, so that all end together."""
DEATHS = 3
"""Workers that one block may cost before the run gives up on it."""


@dataclass
class _Task:
    """A block and what its workers have told so far."""

    known: dict[int, dict[str, Record]]
    deaths: int = 0

    def hear(self, record: Record) -> None:
        self.known[record["scene"]][record["arm"]] = record


def ray_workers(address: str | None = None) -> Workers:
    """Workers on the cluster at `address`, or on one of this machine's own that ends with the run. Raises ConfigError
    where Ray is not installed."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError as error:
        raise ConfigError("--engine ray needs Ray, which is not installed; run pip install 'ray>=2.40'") from error
    return partial(_run, ray, address)


def _run(
    ray: Any, address: str | None, plan: Any, jobs: Sequence[Job], count: int, begin: Begin, work: Work
) -> Iterator[Record]:
    alone: dict[str, Any] = {"num_cpus": count, "include_dashboard": False}
    if address is not None:
        _knock(address)
    ray.init(address=address, log_to_driver=False, **({} if address else alone))
    try:
        yield from _distribute(ray, plan, blocks(jobs, count), count, begin, work)
    finally:
        ray.shutdown()


def _knock(address: str) -> None:
    """Ray waits for minutes where nobody answers; this says so at once."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=5.0).close()
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"no Ray cluster answers at {address} ({error}); give HOST:PORT of one that `ray start --head` began"
        ) from error


def blocks(jobs: Sequence[Job], workers: int) -> list[Sequence[Job]]:
    """Jobs in blocks of BLOCK, smaller where the rest would not go round twice."""
    parts: list[Sequence[Job]] = []
    while jobs:
        size = max(1, min(BLOCK, len(jobs) // (2 * workers)))
        parts.append(jobs[:size])
        jobs = jobs[size:]
    return parts


def _distribute(
    ray: Any, plan: Any, blocks: Sequence[Sequence[Job]], count: int, begin: Begin, work: Work
) -> Iterator[Record]:
    @ray.remote(num_cpus=1, max_restarts=0)
    class Worker:
        def __init__(self) -> None:
            self.ready = False

        def run(self, block: Sequence[Job]) -> Iterator[Record]:
            if not self.ready:
                begin(plan)
                self.ready = True
            yield from work(block)

    waiting = deque(_Task(known={scene: dict(done) for scene, done in block}) for block in blocks)
    idle = [Worker.remote() for _ in range(min(count, len(blocks)))]
    running: dict[Any, tuple[Any, _Task]] = {}
    while waiting or running:
        while waiting and idle:
            task, worker = waiting.popleft(), idle.pop()
            running[worker.run.options(num_returns="streaming").remote(list(task.known.items()))] = worker, task
        (told, *_), _ = ray.wait(list(running), num_returns=1)
        worker, task = running[told]
        try:
            record = ray.get(next(told))
        except StopIteration:
            del running[told]
            idle.append(worker)
        except ray.exceptions.RayTaskError as error:
            raise error.cause from error  # what `begin` or `work` raised
        except ray.exceptions.RayActorError as error:
            del running[told]
            task.deaths += 1
            if task.deaths >= DEATHS:
                scenes = ", ".join(map(str, task.known))
                raise FarError(
                    f"{DEATHS} workers died over scenes {scenes}; every finished episode is kept: {error}"
                ) from error
            waiting.append(task)
            idle.append(Worker.remote())
        else:
            task.hear(record)
            yield record
