"""Who runs an evaluation's scenes: this process, or several here. A cluster: far_app/ray_workers.py.

A worker is set up once by `begin(plan)`; `work(jobs)` then yields the records of the scenes it takes from a stream, one
by one as it has room, and each record is handed on as soon as it is there.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import queue
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol

from far_app.errors import FarError

Record = dict[str, Any]
"""One episode's line of the results."""
Job = tuple[int, dict[str, Record]]
"""A scene, and what is already known of it by arm."""
Begin = Callable[[Any], None]
Work = Callable[[Iterable[Job]], Iterator[Record]]


class Workers(Protocol):
    """Runs jobs side by side and yields their records in any order; `begin` and `work` are importable functions."""

    def __call__(self, plan: Any, jobs: Sequence[Job], count: int, begin: Begin, work: Work) -> Iterator[Record]: ...


def local_workers(plan: Any, jobs: Sequence[Job], count: int, begin: Begin, work: Work) -> Iterator[Record]:
    """Workers on this machine: this process, or `count` others that take from one queue."""
    if count <= 1:
        begin(plan)
        yield from work(jobs)
        return
    context = multiprocessing.get_context("spawn")
    told: Any = context.Queue()
    waiting: Any = context.Queue()
    count = min(count, len(jobs))
    for job in [*jobs, *[None] * count]:
        waiting.put(job)
    with ProcessPoolExecutor(count, context, _take_from, (waiting, told)) as pool:
        pending = {pool.submit(_work, begin, plan, work) for _ in range(count)}
        expected = heard = 0
        while pending or heard < expected:
            with contextlib.suppress(queue.Empty):
                while True:
                    yield told.get(timeout=0.2)
                    heard += 1
            done, pending = wait(pending, timeout=0)
            try:
                expected += sum(future.result() for future in done)
            except BrokenProcessPool as error:
                raise FarError("a worker was killed; every finished episode is kept: start again to go on") from error
            except BaseException:
                _give_out_no_more(waiting, count)
                pool.shutdown(wait=False, cancel_futures=True)
                raise


def _give_out_no_more(waiting: Any, count: int) -> None:
    """The other workers end with what they have."""
    with contextlib.suppress(queue.Empty):
        while True:
            waiting.get(timeout=0.1)
    for _ in range(count):
        waiting.put(None)


_TAKE: dict[str, Any] = {}
"""In a worker: the queues of scenes and of records, and whether it was begun."""


def _take_from(waiting: Any, told: Any) -> None:
    _TAKE.update(waiting=waiting, told=told)


def _work(begin: Begin, plan: Any, work: Work) -> int:
    """In a worker: scenes from the queue until its end, each record to the one who asked as soon as it is there."""
    if "begun" not in _TAKE:
        begin(plan)
        _TAKE["begun"] = True
    count = 0
    for record in work(iter(_TAKE["waiting"].get, None)):
        _TAKE["told"].put(record)
        count += 1
    return count
