"""The pieces of a computation on several threads at once, or one after the other: the same results to the bit.

A torch operation on a chunk's few rows is too short to be split over cores itself: threads that meet at the end of
every one wait for whichever the robot has just interrupted. Pieces of some tens of ms meet once. How a computation is
cut does not depend on how many threads there are.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol, TypeVar, cast

import torch

T = TypeVar("T")
R = TypeVar("R")


class Each(Protocol):
    """Does the work on every piece; results in the pieces' order. After an error no other piece is begun; it is raised
    when those at work are done."""

    def __call__(self, work: Callable[[T], R], pieces: Sequence[T]) -> list[R]: ...


def in_turn(work: Callable[[T], R], pieces: Sequence[T]) -> list[R]:
    """Each, here, one after the other."""
    return [work(piece) for piece in pieces]


@contextlib.contextmanager
def on_threads(count: int) -> Iterator[Each]:
    """Each, on `count` threads with the caller's niceness and its choice whether gradients are kept, torch's operations
    on one of them each; none is at work any more when this is left."""
    if count <= 1:
        yield in_turn
        return
    with ThreadPoolExecutor(count, "learning", initializer=torch.set_num_threads, initargs=(1,)) as pool:

        def each(work: Callable[[T], R], pieces: Sequence[T]) -> list[R]:
            keeps = torch.is_grad_enabled()
            errors: list[BaseException] = []

            def one(piece: T) -> R | None:
                if errors:
                    return None
                try:
                    with torch.set_grad_enabled(keeps):
                        return work(piece)
                except BaseException as error:
                    errors.append(error)
                    return None

            results = list(pool.map(one, pieces))
            if errors:
                raise errors[0]
            return cast("list[R]", results)

        yield each
