"""A person steps in, whole and real: bytes of a gamepad or hands on the arm, the hw server, the session, the export.

The person is the scripted expert; its only way to the arm is the gamepad's sticks and buttons.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest

from far_app.cli import main
from far_app.cli.demo_person import keep
from far_app.cli.options import RunOptions
from far_app.cli.stage import stage
from far_app.config import TaskConfig
from far_app.exchange.foreign import Foreign
from far_app.exchange.robomimic_read import read_robomimic
from far_app.experts import expert
from far_app.learning.dataset import read_episodes
from far_app.motion import ActionScale
from far_app.recording.attempt_reader import read_attempt
from far_app.recording.reader import read_session
from far_app.session.inbox import IntentInbox
from far_app.session.session import Session
from far_app.session.statistics import LoopStatistics
from far_app.session_states import Intent, State
from far_app.take_over import Move, Nudge
from far_app.types import RobotMode
from hw.fake_xarm.control import FakeXArm
from hw.input_device.gamepad import ABS_RX, ABS_RY, ABS_X, ABS_Y, EAST, EV_ABS, EV_KEY, EVENT, SHOULDER, SOUTH, START
from hw.rig import RIGS
from tests.hw.conftest import FAKE_PORT, loopback


class Pad:
    """A gamepad without a person: its events, written where the kernel would put them."""

    def __init__(self, path: Path) -> None:
        os.mkfifo(path)
        self._file = os.open(path, os.O_RDWR | os.O_NONBLOCK)

    def send(self, *events: tuple[int, int, int]) -> None:
        os.write(self._file, b"".join(EVENT.pack(0, 0, *event) for event in events))

    def press(self, button: int) -> None:
        self.send((EV_KEY, button, 1), (EV_KEY, button, 0))

    def act(self, action: np.ndarray) -> None:
        """A policy's action on the sticks; turns about x and y are not asked for."""
        sticks = ((ABS_Y, -action[0]), (ABS_X, -action[1]), (ABS_RY, -action[2]), (ABS_RX, -action[5]))
        grip = (SOUTH, EAST) if action[6] > 0 else (EAST, SOUTH)
        self.send(
            (EV_KEY, SHOULDER, 1), *((EV_ABS, code, round(32767 * float(value))) for code, value in sticks),
            (EV_KEY, grip[0], 1), (EV_KEY, grip[1], 0),
        )  # fmt: skip

    def close(self) -> None:
        os.close(self._file)


@pytest.fixture
def pad(tmp_path: Path) -> Iterator[Pad]:
    made = Pad(tmp_path / "pad")
    yield made
    made.close()


@pytest.fixture
def rig(tmp_path: Path, pad: Pad) -> Path:
    """The twin with that gamepad."""
    file = tmp_path / "twin.toml"
    own = ("[input_device]", 'kind = "gamepad"', f'path = "{tmp_path / "pad"}"', "speed = 1.0", "turn_speed = 1.0")
    own = "\n".join(["", *own, "deadzone = 0.0", ""])
    file.write_text((RIGS / "twin.toml").read_text() + own)
    return file


def rescue(session: Session, pad: Pad, task: TaskConfig, scale: ActionScale) -> None:
    """Watch the policy fail for a while, take over by the pad's button, do the task, let it go on until it ends."""
    standing, robot = session.standing, session.robot
    while not (standing.state is State.RUNNING and session.driver.recorded > 20):
        time.sleep(0.01)
    while standing.state is State.RUNNING:
        pad.press(START)
        time.sleep(0.3)
    assert robot.newest is not None
    act, seen = expert(task, np.random.default_rng(3), scale, robot.newest.eef), -1
    while standing.state is State.TAKEN_OVER:
        observation = robot.newest
        if observation.seq != seen:
            seen = observation.seq
            pad.act(act(observation))
        time.sleep(0.005)


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_a_failing_attempt_is_rescued_recorded_exported_and_read_back(tmp_path, pad, rig, capsys):
    options = RunOptions(
        headless=True, trials=1, seed=11, rig=str(rig), policy="test:wander", recordings=tmp_path / "recordings",
        rerun=False, max_attempts=1,
    )  # fmt: skip
    with stage(options) as made:
        writer = made.writer()
        inbox = IntentInbox()
        with made.session(writer, inbox, LoopStatistics()) as session:
            person = threading.Thread(target=rescue, args=(session, pad, made.task, made.rig.scale_for(made.task)))
            person.start()
            (result,) = session.run()
            person.join(timeout=10)
    assert result.success and not result.counted, "solved, and by nobody's policy"

    recorded = read_session(writer.folder)
    attempt = read_attempt(recorded.files[0])
    theirs = np.array([s.intervention for s in attempt.steps])
    assert not theirs[:15].any() and theirs[-1], "labels say who moved the arm, tick by tick"
    assert {"taken_over"} <= {entry.event for entry in recorded.log}
    limits = made.rig.safety
    positions = np.array([s.observation.eef.position for s in attempt.steps])
    sent = np.array([s.sent for s in attempt.steps if np.isfinite(s.sent).all()])
    scale = made.rig.scale_for(made.task)
    assert np.linalg.norm(sent[:, :3], axis=1).max() * scale.translation <= limits.step_translation + 1e-6
    assert (positions > np.array(limits.box_min) - 0.01).all() and (positions < np.array(limits.box_max) + 0.01).all()
    begins = int(np.flatnonzero(theirs)[0])
    jump = np.linalg.norm(np.diff(positions[begins - 3 : begins + 6], axis=0), axis=1).max()
    assert jump <= 0.3 * scale.translation + 0.002, "the hand-over is no faster than what went before"

    for only in ("human", "recoveries"):
        out = tmp_path / f"{only}.hdf5"
        assert main(["export", str(writer.folder), "--to", "robomimic", "--only", only, "--out", str(out)]) == 0
        with h5py.File(out) as file:
            assert np.array_equal(file["data/demo_0/far/intervention"][:], theirs)
            assert [n.decode() for n in file["mask/human"]] == ["demo_0"]
    _, episodes = read_robomimic(tmp_path / "human.hdf5", Foreign(), lambda line: None)
    (episode,) = episodes
    assert episode.success and len(episode) >= len(attempt.steps)
    (demonstration,) = read_episodes(tmp_path / "human.hdf5", ("front", "wrist"))
    assert demonstration.success and len(demonstration) == len(attempt.steps)

    part = tmp_path / "part.hdf5"
    words = ["export", str(writer.folder), "--to", "robomimic", "--only", "human", "--segment", "recovery"]
    assert main([*words, "--out", str(part)]) == 0
    with h5py.File(part) as file:
        assert np.array_equal(file["data/demo_0/far/intervention"][:], theirs[begins:])
        assert len(file["data/demo_0/actions"]) == len(attempt.steps) - begins


@pytest.mark.timeout(240)
def test_an_xarm_led_by_hand_gives_demonstrations_that_training_reads(tmp_path):
    address = loopback()
    fake = FakeXArm.start(address, FAKE_PORT)
    options = RunOptions(
        headless=True, trials=2, robot="xarm", host=f"{address}:{FAKE_PORT}", recordings=tmp_path / "recordings",
        rerun=False, max_attempts=1, full_speed=True, seed=1_000_000,
    )  # fmt: skip
    path, inbox, ended = tmp_path / "demos.hdf5", IntentInbox(), threading.Event()

    def person(session: Session) -> None:
        """Hands on the arm: 1 mm a push, the hand closed half-way; then a word, then the next word."""
        words, pushed = [Intent.KEEP, Intent.RECORD_AGAIN, Intent.KEEP], 0
        while not ended.wait(0.02):
            inbox.looked_at = time.monotonic()
            standing, robot = session.standing, session.robot.newest
            if standing.state is State.TAKEN_OVER and robot is not None and robot.status.mode is RobotMode.GUIDED:
                pushed += fake.lead(1.0, 0.0, -0.5)
                if pushed == 20:
                    inbox.say(Nudge(move=Move.CLOSE))
                if pushed == 40:
                    inbox.put(Intent.MARK_SUCCESS)
            elif standing.state is State.REVIEWING and words:
                inbox.put(words.pop(0))
                pushed = 0
                time.sleep(0.3)

    try:
        with stage(options, person=True) as made:
            writer = made.writer()
            with made.session(
                writer, inbox, LoopStatistics(), demonstrate="hand", keep=lambda attempt: keep(path, made, attempt)
            ) as session:
                hands = threading.Thread(target=person, args=(session,), daemon=True)
                hands.start()
                session.run()
                ended.set()
                hands.join(timeout=5)
    finally:
        fake.close()

    first, second = read_episodes(path, ())
    assert [first.seed, second.seed] == [1_000_000, 1_000_001] and first.success and second.success
    scale = made.rig.scale_for(made.task).translation
    for episode in (first, second):
        way = episode.states[-1, :3] - episode.states[0, :3]
        assert way[0] > 0.02 and way[2] < -0.01, "the motion is the person's"
        told = scale * episode.actions[:-1, :3].sum(axis=0)
        assert np.allclose(told, way, atol=2 * scale), "and the actions lead along it"
        assert set(np.sign(episode.actions[:, 6])) == {-1.0, 1.0}
    session_read = read_session(writer.folder)
    assert len(session_read.files) == 3, "what was not kept is recorded, too"
    assert [e.text for e in session_read.log if e.event == "demonstration"] == ["keep", "record_again", "keep"]
    assert all(s.intervention for s in read_attempt(session_read.files[0]).steps)
