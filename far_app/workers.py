"""Who runs an evaluation's blocks of scenes: this process, or several here. A cluster: far_app/ray_workers.py.

A worker is set up once by `begin(plan)`; `work(block)` then yields a block's records, and each is handed on as soon as
it is there.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import queue
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol

from far_app.errors import FarError

Record = dict[str, Any]
"""One episode's line of the results."""
Job = tuple[int, dict[str, Record]]
"""A scene, and what is already known of it by arm."""
Block = Sequence[Job]
Begin = Callable[[Any], None]
Work = Callable[[Block], Iterator[Record]]


class Workers(Protocol):
    """Runs blocks side by side and yields their records in any order; `begin` and `work` are importable functions."""

    def __call__(
        self, plan: Any, blocks: Sequence[Block], count: int, begin: Begin, work: Work
    ) -> Iterator[Record]: ...


def local_workers(plan: Any, blocks: Sequence[Block], count: int, begin: Begin, work: Work) -> Iterator[Record]:
    """Workers on this machine: this process, or `count` others."""
    if count <= 1:
        begin(plan)
        for block in blocks:
            yield from work(block)
        return
    context = multiprocessing.get_context("spawn")
    told: Any = context.Queue()
    with ProcessPoolExecutor(min(count, len(blocks)), context, _begin_worker, (begin, plan, work, told)) as pool:
        pending = {pool.submit(_work, block) for block in blocks}
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
                pool.shutdown(wait=False, cancel_futures=True)
                raise


_TELL: dict[str, Any] = {}


def _begin_worker(begin: Begin, plan: Any, work: Work, told: Any) -> None:
    begin(plan)
    _TELL.update(work=work, told=told)


def _work(block: Block) -> int:
    """In a worker: each record to the one who asked, as soon as it is there."""
    count = 0
    for record in _TELL["work"](block):
        _TELL["told"].put(record)
        count += 1
    return count
