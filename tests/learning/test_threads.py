"""The pieces of a computation on threads: in order, stopped by an error, gradients kept as the caller has it."""

import threading

import pytest
import torch

from far_app.learning.threads import on_threads

COUNTS = pytest.mark.parametrize("count", [1, 2, 5])


@COUNTS
def test_results_come_in_the_pieces_order(count):
    late = threading.Event()

    def work(piece: int) -> int:
        if piece == 0 and count > 1:
            assert late.wait(5), "the others wait for the first"
        late.set()
        return piece * piece

    with on_threads(count) as each:
        assert each(work, range(7)) == [piece * piece for piece in range(7)]
        assert each(work, []) == []


@COUNTS
def test_an_error_is_raised_here_and_no_other_piece_is_begun(count):
    begun = []

    def work(piece: int) -> None:
        begun.append(piece)
        raise ValueError(f"piece {piece}")

    with on_threads(count) as each, pytest.raises(ValueError, match="piece"):
        each(work, range(1000))
    assert len(begun) <= count


def test_nobody_is_at_work_any_more_when_it_is_left():
    with on_threads(3) as each:
        names = each(lambda _: threading.current_thread().name, range(3))
    assert set(names).isdisjoint(t.name for t in threading.enumerate())


@COUNTS
@pytest.mark.parametrize("keeps", [True, False])
def test_gradients_are_kept_as_the_caller_has_it(count, keeps):
    leaf = torch.ones(2, requires_grad=True)
    with on_threads(count) as each, torch.set_grad_enabled(keeps):
        sums = each(lambda piece: (leaf * piece).sum(), range(3))
    assert [s.requires_grad for s in sums] == [keeps] * 3
