"""Decoded pictures are the dataset's own; a changed dataset never finds old ones; random shifts repeat the edges."""

import dataclasses
import os

import numpy as np
import pytest
import torch

from far_app.errors import RecordingError
from far_app.learning import decoded
from far_app.learning.dataset import read_episodes, write_episode
from far_app.learning.decoded import decoded_episodes
from far_app.learning.segments import DemonstrationArrays, DeviceDemonstrations
from far_app.picture import Framing
from tests.learning.test_train_policy import CONFIG, episodes

CAMERAS = ("front", "wrist")


@pytest.fixture
def dataset(tmp_path):
    path = tmp_path / "d.hdf5"
    for number, episode in enumerate(episodes(4)):
        length = 12 - number
        cut = {f.name: getattr(episode, f.name) for f in dataclasses.fields(episode)}
        cut |= {k: v[:length] for k, v in cut.items() if isinstance(v, np.ndarray)}
        cut["images"] = {c: v[:length] + number for c, v in episode.images.items()}
        write_episode(path, dataclasses.replace(episode, **cut), {"env_name": "Lift"})
    return path


def same(some, others):
    assert len(some) == len(others)
    for a, b in zip(some, others, strict=True):
        assert all(np.array_equal(a.images[c], b.images[c]) for c in CAMERAS)
        assert np.array_equal(a.actions, b.actions) and np.array_equal(a.states, b.states)


def test_decoded_pictures_are_the_datasets_own_and_are_decoded_once(dataset, monkeypatch):
    whole = read_episodes(dataset, CAMERAS)
    same(decoded_episodes(dataset, CAMERAS), whole)
    monkeypatch.setattr(decoded, "_decode", lambda *_: pytest.fail("decoded again"))
    again = decoded_episodes(dataset, CAMERAS)
    same(again, whole)
    assert all(isinstance(a, np.memmap) and not a.flags.writeable for a in again[0].images.values())


def test_every_choice_has_pictures_of_its_own(dataset):
    same(decoded_episodes(dataset, CAMERAS, 2), read_episodes(dataset, CAMERAS, 2))
    small = {"size": 8, "framings": {"front": Framing(), "wrist": Framing()}}
    same(decoded_episodes(dataset, CAMERAS, 2, **small), read_episodes(dataset, CAMERAS, 2, **small))
    same(decoded_episodes(dataset, CAMERAS), read_episodes(dataset, CAMERAS))


def test_a_changed_dataset_is_decoded_anew(dataset):
    decoded_episodes(dataset, CAMERAS)
    write_episode(dataset, episodes(1)[0], {"env_name": "Lift"})
    os.utime(dataset, ns=(1, 1))
    same(decoded_episodes(dataset, CAMERAS), read_episodes(dataset, CAMERAS))
    assert len(list(dataset.with_name("d.hdf5.decoded").iterdir())) == 1, "the old pictures are gone"


def test_nothing_half_decoded_is_left_or_used(dataset, monkeypatch):
    read = decoded.read_episodes

    def until_full(path, cameras, *arguments, first=0, **named):
        if first == 2:
            raise OSError(28, "No space left on device")
        return read(path, cameras, *arguments, first=first, **named)

    monkeypatch.setattr(decoded, "read_episodes", until_full)
    same(decoded_episodes(dataset, CAMERAS), read_episodes(dataset, CAMERAS))
    assert not list(dataset.with_name("d.hdf5.decoded").glob("*/*"))
    monkeypatch.setattr(decoded, "read_episodes", read)
    same(decoded_episodes(dataset, CAMERAS), read_episodes(dataset, CAMERAS))


def test_what_is_missing_is_said_as_ever(dataset, tmp_path):
    with pytest.raises(RecordingError, match="no images of side"):
        decoded_episodes(dataset, ("side",))
    with pytest.raises(RecordingError, match="far demo"):
        decoded_episodes(tmp_path / "none.hdf5", CAMERAS)


def test_a_random_shift_is_a_crop_of_the_picture_with_its_edges_repeated():
    some, shift = episodes(3), 3
    arrays = DemonstrationArrays(some, CONFIG, shift)
    drawn = arrays.segments(6, 4, np.random.default_rng(1))
    rng = np.random.default_rng(1)
    rng.integers(0, len(arrays.ends), 6)
    offsets = rng.integers(0, 2 * shift + 1, (6, 2))
    padded = [np.pad(e.images["front"], ((0, 0), (shift, shift), (shift, shift), (0, 0)), mode="edge") for e in some]
    everything = np.concatenate(padded)
    for i, (y, x) in enumerate(offsets):
        for t, row in enumerate(drawn.rows[i]):
            assert np.array_equal(drawn.images["front"][i, t + 1].numpy(), everything[row, y : y + 16, x : x + 16])


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(
    not torch.cuda.is_available(), reason="needs a GPU"))])  # fmt: skip
def test_batches_gathered_on_a_device_are_the_same(device):
    some = episodes(3)
    here, there = (form(some, CONFIG, 3, *rest) for form, rest in ((DemonstrationArrays, ()),
                                                                  (DeviceDemonstrations, (device,))))  # fmt: skip
    for seed in range(4):
        one, other = (arrays.segments(5, 4, np.random.default_rng(seed)) for arrays in (here, there))
        assert all(torch.equal(one.images[c], other.images[c].cpu()) for c in CAMERAS)
        assert torch.equal(one.chunks, other.chunks) and np.array_equal(one.rows, other.rows)
