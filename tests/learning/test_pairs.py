"""Candidates, distance filter, empty-set rule, TopK."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from far_app.config import PairsConfig
from far_app.learning.cancellation import AdaptationCancelledError, never
from far_app.learning.pairs import (
    BATCH,
    candidates,
    distance,
    explored,
    merged,
    moderate,
    select,
    top_k,
    weighted_trajectory,
)

H, A = 3, 7


def by_first_entry(features, chunks):
    """Q of a chunk: its first number."""
    return chunks[:, 0, 0]


def chunks_at(distances: list[float]) -> torch.Tensor:
    """One state's candidates at these distances from a zero negative (along one arm entry)."""
    chunks = torch.zeros(1, len(distances), H, A)
    chunks[0, :, 1, 2] = torch.tensor(distances)
    return chunks


def test_distance_is_l2_over_the_chunk_without_the_gripper():
    chunks, negatives = torch.zeros(1, 1, H, A), torch.zeros(1, H, A)
    chunks[0, 0, 0, 0], chunks[0, 0, 2, 5] = 3.0, 4.0
    chunks[0, 0, 1, 6] = 2.0
    assert distance(chunks, negatives, arm_only=True).item() == pytest.approx(5.0)
    assert distance(chunks, negatives, arm_only=False).item() == pytest.approx(np.sqrt(29.0))


def test_moderate_keeps_from_the_mean_to_d_max():
    """Distances 0.2, 0.4, 0.6, 1.2: mean 0.6, so 0.6 alone lies in [0.6, 1.0]."""
    safe, empty = moderate(torch.tensor([[0.2, 0.4, 0.6, 1.2]]), PairsConfig(candidates=8, positives=8))
    assert safe.tolist() == [[False, False, True, False]]
    assert empty.tolist() == [False]


def test_an_empty_set_drops_d_max_and_is_counted_or_skips_the_state():
    distances = torch.tensor([[1.0, 2.0, 3.0]])
    safe, empty = moderate(distances, PairsConfig(on_empty="drop_d_max"))
    assert safe.tolist() == [[False, True, True]]
    assert empty.tolist() == [True]
    safe, empty = moderate(distances, PairsConfig(on_empty="skip"))
    assert not safe.any()
    assert empty.tolist() == [True]


def test_exploring_moves_a_candidate_by_one_translation_and_leaves_the_first_alone():
    chunks = 0.2 * torch.rand(2, 5, H, A) - 0.1
    moved = explored(chunks, 0.3, np.random.default_rng(0))
    offsets = moved - chunks
    assert torch.equal(moved[:, 0], chunks[:, 0])
    assert torch.equal(moved[..., 3:], chunks[..., 3:])  # neither rotation nor gripper
    assert torch.allclose(offsets[:, :, :1].expand_as(offsets), offsets, atol=1e-6)
    assert offsets[:, 1:, 0, :3].abs().min() > 0


def test_explored_candidates_are_actions():
    moved = explored(torch.ones(1, 64, H, A), 2.0, np.random.default_rng(0))
    assert moved.abs().max() == 1.0


def test_d_min_may_be_a_number():
    safe, _ = moderate(torch.tensor([[0.05, 0.5, 0.9, 1.5]]), PairsConfig(d_min=0.1))
    assert safe.tolist() == [[False, True, True, False]]


@given(st.integers(0, 10_000), st.integers(1, 12))
@settings(deadline=None)
def test_top_k_takes_the_best_of_the_allowed(seed, k):
    rng = np.random.default_rng(seed)
    scores = torch.from_numpy(rng.normal(size=(3, 9)))
    allowed = torch.from_numpy(rng.random((3, 9)) < 0.5)
    chosen = top_k(scores, allowed, k)
    for row in range(3):
        expected = sorted(scores[row][allowed[row]].tolist(), reverse=True)[:k]
        assert sorted(scores[row][chosen[row]].tolist(), reverse=True) == expected


def test_select_pairs_each_positive_with_its_own_state():
    chunks = torch.cat([chunks_at([0.1, 0.5, 0.6]), chunks_at([5.0, 5.0, 5.0]), chunks_at([0.1, 0.2, 0.9])])
    chunks[:, :, 0, 6] = torch.tensor([1.0, 2.0, 3.0])
    config = PairsConfig(candidates=3, positives=1, on_empty="skip")
    features = torch.arange(6.0).reshape(3, 2)

    def score(f, c):
        return c[:, 0, 6]

    pairs = select(chunks, features, torch.zeros(3, H, A), score, config)
    assert pairs.features.tolist() == [[0.0, 1.0], [4.0, 5.0]]
    assert pairs.owner.tolist() == [0, 1]
    assert pairs.positives[:, 1, 2].tolist() == pytest.approx([0.6, 0.9])
    assert (pairs.empty_states, pairs.dropped_states) == (1, 1)


def test_random_choice_neither_filters_nor_ranks():
    """The paper's ablation: K plain samples."""
    chunks = chunks_at([0.0, 9.0, 0.5])
    config = PairsConfig(choose="random", candidates=3, positives=2)
    pairs = select(chunks, torch.zeros(1, 2), torch.zeros(1, H, A), by_first_entry, config)
    assert pairs.positives[:, 1, 2].tolist() == [0.0, 9.0]
    assert pairs.empty_states == 0


def test_candidates_belong_to_their_state_and_noise():
    """A sampler that adds the state to the noise shows who was asked what, across batch borders."""
    states, per_state = 5, 40
    noise = torch.randn(states, per_state, H, A)
    features = torch.arange(float(states))[:, None]
    sizes = []

    def sample(f, n):
        sizes.append(len(n))
        return n + f[:, :, None]

    found = candidates(sample, features, noise, never)
    assert torch.equal(found, noise + features[:, :, None, None])
    assert max(sizes) <= BATCH


def test_cancellation_is_seen_between_batches():
    calls = []

    def sample(f, n):
        calls.append(len(n))
        return n

    with pytest.raises(AdaptationCancelledError):
        candidates(sample, torch.zeros(4, 1), torch.zeros(4, BATCH, H, A), lambda: len(calls) >= 2)
    assert len(calls) == 2


def test_no_flagged_state_gives_no_pairs():
    empty = candidates(lambda f, n: n, torch.zeros(0, 2), torch.zeros(0, 4, H, A), never)
    pairs = select(
        empty, torch.zeros(0, 2), torch.zeros(0, H, A), by_first_entry, PairsConfig(candidates=4, positives=2)
    )
    assert len(pairs) == 0


def test_merged_rounds_keep_owners():
    chunks = chunks_at([0.1, 0.5, 0.6])
    config = PairsConfig(candidates=3, positives=2, d_min=0.0)
    one = select(chunks, torch.tensor([[1.0]]), torch.zeros(1, H, A), by_first_entry, config)
    two = select(chunks, torch.tensor([[2.0]]), torch.zeros(1, H, A), by_first_entry, config)
    both = merged([one, two])
    assert both.features[both.owner].flatten().tolist() == [1.0, 1.0, 2.0, 2.0]


def test_advantage_weights_are_exp_of_three_times_the_advantage_clipped_at_a_hundred():
    pairs = weighted_trajectory(torch.zeros(3, 2), torch.zeros(3, H, A), torch.tensor([0.0, -1.0, 9.0]))
    assert pairs.weights.tolist() == pytest.approx([1.0, np.exp(-3.0), 100.0], rel=1e-5)
