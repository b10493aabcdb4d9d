"""A disk that is full, gone or too slow ends the recording with an error for the session, and nothing is lost in
silence."""

import errno
import os
import resource
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from far_app.errors import RecordingError
from far_app.recording.attempt_reader import read_attempt
from far_app.recording.inspect import inspect_session
from far_app.recording.session_folder import check_space
from far_app.recording.writer import SessionWriter

from . import sessions, values


@contextmanager
def largest_file(limit: int) -> Iterator[None]:
    """No file of this process may grow beyond the limit, bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("mounting a small disk needs root")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def record_until_it_fails(writer: SessionWriter) -> RecordingError:
    writer.begin_trial(1, 7)
    writer.begin_attempt(1, "base")
    rng = np.random.default_rng(0)
    noise = {camera: rng.integers(0, 256, (84, 84, 3), dtype=np.uint8) for camera in values.CAMERAS}
    for tick in range(3000):
        frames = {camera: np.roll(image, tick, axis=0) for camera, image in noise.items()}
        step = values.step(tick)
        object.__setattr__(step.observation, "images", frames)
        try:
            writer.add_step(step)
        except RecordingError as error:
            return error
        time.sleep(0.01)
    raise AssertionError("the disk was never full")


def check_what_is_left(folder: Path, error: RecordingError) -> None:
    recording = read_attempt(folder / "trial_0001/attempt_1.mcap")
    assert [step.tick for step in recording.steps] == list(range(len(recording.steps)))
    assert not recording.closed and not recording.damaged
    report = inspect_session(folder)
    assert not report.sound
    assert str(folder) in str(error) and "free some space" in str(error)


def test_a_full_disk_reaches_the_session_by_call_and_by_callback(tmp_path: Path, tiny_disk: Path) -> None:
    heard: list[RecordingError] = []
    writer = sessions.open_writer(tiny_disk, on_error=heard.append)
    error = record_until_it_fails(writer)
    assert os.strerror(errno.ENOSPC) in str(error)
    assert heard == [error]
    with pytest.raises(RecordingError):
        writer.event("anything")
    writer.close()
    check_what_is_left(writer.folder, error)
    with pytest.raises(RecordingError, match="cannot start a recording"):
        sessions.open_writer(tiny_disk)


def test_a_file_that_may_not_grow_ends_the_recording(tmp_path: Path) -> None:
    writer = sessions.open_writer(tmp_path)
    with largest_file(200_000):
        error = record_until_it_fails(writer)
    writer.close()
    assert os.strerror(errno.EFBIG) in str(error)
    check_what_is_left(writer.folder, error)
    assert inspect_session(writer.folder).state == "failed"


def test_an_error_nobody_heard_of_is_raised_at_the_close(tmp_path: Path) -> None:
    writer = sessions.open_writer(tmp_path)
    writer.begin_trial(1, 7)
    (writer.folder / "trial_0002").mkdir()
    writer.begin_trial(2, 8)
    with pytest.raises(RecordingError, match="File exists"):
        writer.close()


def test_a_session_does_not_start_without_room(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"MB are free for recordings in .*, at least 1000000000000 MB are needed"):
        SessionWriter(tmp_path, sessions.INFO, space_to_start=10**18)
    assert list(tmp_path.iterdir()) == []
    check_space(tmp_path / "not" / "there" / "yet", 0)


def test_a_session_does_not_start_where_it_cannot_write(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(RecordingError, match="cannot"):
        sessions.open_writer(tmp_path / "file" / "recordings")


def test_a_disk_running_full_closes_the_files_while_there_is_room(tmp_path: Path) -> None:
    writer = sessions.open_writer(tmp_path, space_to_go_on=10**18)
    writer.begin_trial(1, 7)
    writer.begin_attempt(1, "base")
    with pytest.raises(RecordingError, match="a session goes on down to"):
        for tick in range(100):
            writer.add_step(values.step(tick))
            time.sleep(0.02)
    writer.close()
    recording = read_attempt(writer.folder / "trial_0001/attempt_1.mcap")
    assert recording.closed and recording.problems == ()
    assert "a session goes on down to" in recording.abandoned
    assert inspect_session(writer.folder).state == "failed"


def test_a_disk_too_slow_ends_the_recording_but_keeps_what_was_handed_over(tmp_path: Path) -> None:
    stuck, go_on = threading.Event(), threading.Event()

    def slow(path: Path) -> None:
        stuck.set()
        go_on.wait()

    writer = sessions.open_writer(tmp_path, queue_limit=20, on_attempt_closed=slow)
    writer.begin_trial(1, 7)
    writer.begin_attempt(1, "base")
    writer.end_attempt(values.attempt(1, 3))
    writer.begin_attempt(2, "base")
    assert stuck.wait(10)
    with pytest.raises(RecordingError, match=r"the disk does not keep up: 20 values wait .* the limit is 20"):
        for tick in range(100):
            writer.add_step(values.step(tick))
    go_on.set()
    writer.close()
    recording = read_attempt(writer.folder / "trial_0001/attempt_2.mcap")
    assert len(recording.steps) == 19 + 1 and not recording.damaged
    assert inspect_session(writer.folder).state == "failed"


def test_a_value_that_cannot_be_recorded_ends_the_recording_with_the_steps_before_it(tmp_path: Path) -> None:
    writer = sessions.open_writer(tmp_path)
    writer.begin_trial(1, 7)
    writer.begin_attempt(1, "base")
    writer.add_step(values.step(0))
    bad = values.step(1)
    object.__setattr__(bad.observation, "images", {"front": np.zeros((84, 84), np.float32)})
    writer.add_step(bad)
    with pytest.raises(RecordingError, match="float32"):
        writer.close()
    recording = read_attempt(writer.folder / "trial_0001/attempt_1.mcap")
    assert len(recording.steps) == 1 and recording.closed
    assert "float32" in recording.abandoned
