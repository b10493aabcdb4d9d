"""Training: repeatable, resumable, and it learns."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from far_app.errors import ConfigError, RecordingError
from far_app.learning.dataset import Episode, check_origin, read_episodes, write_episode
from far_app.learning.policy import fingerprint, load_policy, preset
from far_app.learning.policy_step import FastStep, LowStep, PlainStep
from far_app.learning.segments import DemonstrationArrays
from far_app.learning.train_policy import PolicyTraining, begun, learning_rate, train_policy
from hw.camera_config import CameraConfig
from hw.camera_reader import CameraReader
from hw.capture import Shot
from hw.hardware_view import HardwareCamera
from hw.synthetic_camera import SyntheticCapture

CONFIG = dataclasses.replace(preset("quickstart", "lift"), image_size=16, widths=(16, 32, 64))
TRAINING = PolicyTraining(iterations=6, batch=8, segment=4, draws=2, shift=2, save_every=3, log_every=2, localise=1.0)


def episodes(count: int = 3, length: int = 12, size: int = 16) -> list[Episode]:
    rng = np.random.default_rng(0)
    return [
        Episode(
            images={c: rng.integers(0, 256, (length, size, size, 3), np.uint8) for c in ("front", "wrist")},
            states=rng.normal(size=(length, 8)).astype(np.float32),
            actions=rng.uniform(-1, 1, (length, 7)).astype(np.float32), rewards=np.zeros(length, np.float32),
            successes=np.zeros(length, bool), success=True, seed=i, objects=rng.normal(size=(length, 7)),
        )
        for i in range(count)
    ]  # fmt: skip


def test_episodes_of_two_arms_are_never_mixed(tmp_path):
    def origin(robots: str) -> dict[str, object]:
        return {"env_name": "Lift", "type": 1, "env_kwargs": {"robots": robots}}

    path = tmp_path / "d.hdf5"
    check_origin(path, origin("panda"))
    write_episode(path, episodes(1)[0], origin("XArm7"))
    check_origin(path, origin("xarm7"))
    with pytest.raises(ConfigError, match="episodes of Lift on xarm7, these would be of Lift on panda"):
        check_origin(path, origin("panda"))


def test_segments_never_cross_an_episode_and_chunks_repeat_the_last_action():
    some = episodes()
    arrays = DemonstrationArrays(some, CONFIG, shift=0)
    rng = np.random.default_rng(0)
    for _ in range(20):
        drawn = arrays.segments(2, 4, rng)
        images, states, chunks = drawn.images, drawn.states, drawn.chunks
        assert (arrays.states[drawn.rows[:, -1]] == states[:, -1].numpy()).all()
        for row in range(2):
            episode = next(e for e in some if (states[row, -1].numpy() == e.states).all(axis=1).any())
            last = int(np.flatnonzero((states[row, -1].numpy() == episode.states).all(axis=1))[0])
            ticks = np.clip(np.arange(last - 4, last + 1), 0, None)
            assert (images["front"][row].numpy()[1:] == episode.images["front"][ticks[1:]]).all()
            wanted = episode.actions[np.minimum(last + np.arange(8), len(episode) - 1)]
            assert np.allclose(chunks[row, -1], wanted)


@pytest.fixture
def one_thread():
    """What `--threads 1` promises: the same weights to the bit. Libraries that share out sums may do it in any way."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("one_thread")
def test_the_same_seed_gives_the_same_weights(tmp_path):
    first = train_policy(episodes(), CONFIG, TRAINING, tmp_path / "a")
    second = train_policy(episodes(), CONFIG, TRAINING, tmp_path / "b")
    assert fingerprint(load_policy(first)) == fingerprint(load_policy(second))


@pytest.mark.usefixtures("one_thread")
def test_an_interrupted_run_ends_with_the_same_weights(tmp_path, monkeypatch):
    whole = train_policy(episodes(), CONFIG, TRAINING, tmp_path / "whole")
    calls = {"n": 0}
    draw = DemonstrationArrays.segments

    def until_killed(self, *arguments):
        calls["n"] += 1
        if calls["n"] == 5:
            raise KeyboardInterrupt
        return draw(self, *arguments)

    monkeypatch.setattr(DemonstrationArrays, "segments", until_killed)
    with pytest.raises(KeyboardInterrupt):
        train_policy(episodes(), CONFIG, TRAINING, tmp_path / "parts")
    monkeypatch.undo()
    resumed = train_policy(episodes(), CONFIG, TRAINING, tmp_path / "parts")
    assert fingerprint(load_policy(resumed)) == fingerprint(load_policy(whole))


@pytest.mark.parametrize("name", ["quickstart", "paper", "state"])
def test_a_fast_step_is_the_plain_one(name):
    """The same losses and the same weights after some steps from the same batches and the same noise."""
    config = dataclasses.replace(preset(name, "lift"), image_size=32, widths=(16, 32, 64))
    training = dataclasses.replace(TRAINING, shift=2 * bool(config.cameras), lr=1e-3)
    arrays = DemonstrationArrays(episodes(size=32), config, training.shift)
    losses: dict[type[PlainStep], list[float]] = {PlainStep: [], FastStep: []}
    moved = {}
    for form, kept in losses.items():
        torch.manual_seed(0)
        step = begun(form, config, training, arrays)
        rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
        for _ in range(5):
            loss = step.loss(arrays.segments(2, 4, rng), generator, torch.linspace(0.5, 1.5, 8))
            step.update(loss, 1e-3, decay=0.5)
            kept.append(loss.item())
        moved[form] = torch.cat([p.flatten() for p in step.ema.parameters()])
    assert losses[FastStep] == pytest.approx(losses[PlainStep], rel=1e-4)
    apart = (moved[FastStep] - moved[PlainStep]).abs()
    assert apart.mean() < 2e-5, "AdamW makes 1e-3 of the smallest gradient: a few weights may differ"


def test_cameras_in_bf16_learn_the_same_within_its_rounding():
    """The pictures show something, so that features are more than the mean of a grid."""
    config = dataclasses.replace(preset("quickstart", "lift"), image_size=32, widths=(16, 32, 64))
    training = dataclasses.replace(TRAINING, shift=2)
    arrays = DemonstrationArrays(episodes(size=32), config, training.shift)
    seen, losses = {}, {}
    for form in (FastStep, LowStep):
        torch.manual_seed(0)
        step = begun(form, config, training, arrays)
        for parameter in step.policy.encoder.parameters():
            parameter.data.mul_(3.0)
        rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
        drawn = arrays.segments(2, 4, rng)
        seen[form] = step._features(drawn.images, drawn.states)
        losses[form] = []
        for _ in range(5):
            loss = step.loss(arrays.segments(2, 4, rng), generator, None)
            step.update(loss, 1e-3, decay=0.5)
            losses[form].append(loss.item())
    apart = (seen[LowStep] - seen[FastStep]).abs()
    assert 1e-5 < apart.max() < 0.05, "it rounds, and no more than that"
    assert seen[LowStep].dtype == torch.float32
    assert losses[LowStep] == pytest.approx(losses[FastStep], rel=0.02)


def test_a_run_by_plain_steps_learns_the_same(tmp_path):
    logs = {}
    for plain in (True, False):
        train_policy(episodes(), CONFIG, TRAINING, tmp_path / str(plain), form=PlainStep if plain else FastStep)
        lines = (tmp_path / str(plain) / "log.jsonl").read_text().splitlines()
        logs[plain] = [json.loads(line)["loss"] for line in lines]
    assert len(logs[True]) == 3 and logs[False] == pytest.approx(logs[True], rel=1e-3)


def test_the_loss_falls_on_one_demonstration(tmp_path):
    training = dataclasses.replace(
        TRAINING, iterations=160, log_every=20, lr=3e-3, save_every=1000, warmup=5, localise=0.0
    )
    (episode,) = episodes(1)
    still = dataclasses.replace(episode, actions=np.full_like(episode.actions, 0.4))
    train_policy([still], CONFIG, training, tmp_path)
    losses = [json.loads(line)["loss"] for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert losses[-1] < 0.85 * losses[0]


def test_a_folder_of_other_settings_is_refused(tmp_path):
    train_policy(episodes(), CONFIG, TRAINING, tmp_path)
    with pytest.raises(ConfigError, match="other settings"):
        train_policy(episodes(), CONFIG, dataclasses.replace(TRAINING, lr=1e-3), tmp_path)


def test_learning_rate_warms_up_and_ends_low():
    training = PolicyTraining()
    assert learning_rate(training, 0) == pytest.approx(1e-6)
    assert learning_rate(training, 100) == pytest.approx(1e-4)
    assert learning_rate(training, 29_999) == pytest.approx(1e-5, rel=1e-3)


def test_demonstrations_survive_the_disk(tmp_path):
    path, (episode,) = tmp_path / "d.hdf5", episodes(1)
    for _ in range(2):
        write_episode(path, episode, {"env_name": "Lift", "type": 1, "env_kwargs": {}})
    again = read_episodes(path, ("front", "wrist"))
    assert len(again) == 2
    assert all((again[0].images[c] == episode.images[c]).all() for c in ("front", "wrist"))
    assert np.array_equal(again[0].actions, episode.actions)
    assert np.array_equal(again[0].states, episode.states)
    with pytest.raises(RecordingError, match="no images of side"):
        read_episodes(path, ("side",))
    with pytest.raises(RecordingError, match="far demo"):
        read_episodes(tmp_path / "none.hdf5", ("front",))


def test_a_policy_sees_the_same_pixels_live_and_in_its_dataset(tmp_path):
    """Whole frames in a dataset become pictures by the function that frames live ones; framed ones are left alone."""
    config = CameraConfig(device="synthetic", width=512, height=144, eye="left", crop=(30, 4, 120, 120))
    (framing,) = config.views("front").values()
    frame = np.random.default_rng(3).integers(0, 256, (144, 512, 3), np.uint8)
    reader = CameraReader("front", SyntheticCapture(config), config)
    reader.newest = Shot(image=np.ascontiguousarray(frame[:, :, ::-1]), stamp=1.0)
    live = HardwareCamera("front", 84, reader, framing).frame().image

    (episode,) = episodes(1)
    for name, picture in (("whole", frame), ("framed", live)):
        there = dataclasses.replace(episode, images={"front": np.repeat(picture[None], len(episode), axis=0)})
        write_episode(tmp_path / name, there, {"env_name": "Lift"})
        (again,) = read_episodes(tmp_path / name, ("front",), size=84, framings={"front": framing})
        assert all(np.array_equal(picture, live) for picture in again.images["front"]), name
