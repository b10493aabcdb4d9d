"""SIGKILL at any moment costs less than the last second, and what is left reads back and says what is missing."""

import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from far_app.recording.attempt_reader import read_attempt
from far_app.recording.inspect import inspect_session
from far_app.recording.reader import read_session

from . import sessions, values

_WRITER = """
import sys, time
from pathlib import Path
from tests.recording import sessions, values

writer = sessions.open_writer(Path(sys.argv[1]))
writer.begin_trial(1, 7)
number = 0
while True:
    number += 1
    writer.begin_attempt(number, "base")
    start = time.monotonic()
    for tick in range(45):
        writer.add_chunk(values.chunk(tick))
        writer.add_step(values.step(tick, start))
        print(number, tick, time.monotonic(), flush=True)
        time.sleep(max(0.0, start + (tick + 1) / 30 - time.monotonic()))
    writer.end_attempt(values.attempt(number, 45, start))
    writer.add_adaptation(values.adaptation(45))
"""
_ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_sigkill_at_any_moment_loses_at_most_the_last_second(tmp_path: Path, seed: int) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", _WRITER, str(tmp_path)], stdout=subprocess.PIPE, text=True, cwd=_ROOT
    )
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(random.Random(seed).uniform(0.2, 3.5))
    killed = time.monotonic()
    process.send_signal(signal.SIGKILL)
    process.wait()
    handed = [line.split() for line in process.stdout.read().splitlines()]
    must_be_there = {(int(a), int(tick)) for a, tick, stamp in handed if float(stamp) < killed - 1.0}

    [folder] = tmp_path.iterdir()
    there = set()
    for recording in read_session(folder).attempts():
        assert not recording.damaged
        assert recording.header is not None
        for step in recording.steps:
            expected = values.frame(step.tick, "front")
            assert (step.observation.images["front"] == expected).all()
            there.add((recording.header.attempt, step.tick))
    assert must_be_there <= there

    report = inspect_session(folder)
    assert report.state == "cut off" and not report.sound
    assert "the session was not closed in order" in report.problems
    assert any("was not closed" in problem for problem in report.problems[:-1])
    closed = [attempt.closed for trial in report.trials for attempt in trial.attempts]
    assert closed == [True] * (len(closed) - 1) + [False]


@pytest.mark.slow
def test_a_file_cut_at_any_byte_reads_back_to_the_cut(tmp_path: Path) -> None:
    file, whole = _small_file(tmp_path)
    raw, cut = file.read_bytes(), tmp_path / "cut.mcap"
    end_of_data = raw.rindex(b"zstd")  # within the last chunk's index in the summary
    last_chunk = raw.rindex(b"zstd", 0, len(raw) // 2)
    every_byte = [*range(last_chunk - 300, last_chunk + 600), *range(end_of_data, len(raw))]
    counts = set()
    for length in sorted({*range(0, len(raw), 61), *every_byte}):
        cut.write_bytes(raw[:length])
        recording = read_attempt(cut)
        assert not recording.closed and not recording.damaged, length
        assert "the file was not closed" in recording.problems
        assert [step.tick for step in recording.steps] == list(range(len(recording.steps)))
        if len(recording.steps) not in counts:
            counts.add(len(recording.steps))
            assert values.same(recording.steps, whole.steps[: len(recording.steps)]), length
    assert len(counts) > 2 and max(counts) == len(whole.steps)


@pytest.mark.slow
def test_any_damaged_byte_is_reported_and_nothing_wrong_is_read(tmp_path: Path) -> None:
    file, whole = _small_file(tmp_path)
    raw, damaged = file.read_bytes(), tmp_path / "damaged.mcap"
    rng = random.Random(1)
    positions = [*range(8, 80), *rng.sample(range(80, len(raw) - 400), 250), *range(len(raw) - 400, len(raw))]
    for position in positions:
        broken = bytearray(raw)
        broken[position] ^= 1 << rng.randrange(8)
        damaged.write_bytes(broken)
        recording = read_attempt(damaged)
        assert recording.problems, f"a flipped bit at byte {position} of {len(raw)} went unnoticed"
        for step in recording.steps:
            true = whole.steps[step.tick]
            frames = {camera: true.observation.images[camera] for camera in step.observation.images}
            assert values.same(step, replace(true, observation=replace(true.observation, images=frames))), position


def test_a_chunk_with_a_wrong_checksum_costs_only_itself(tmp_path: Path) -> None:
    file, whole = _small_file(tmp_path)
    raw = bytearray(file.read_bytes())
    middle = raw.index(b"zstd", raw.index(b"zstd", raw.index(b"zstd") + 4) + 4) + 40
    raw[middle] ^= 0xFF
    file.write_bytes(raw)
    recording = read_attempt(file)
    assert recording.damaged and recording.closed
    assert any("damaged and passed over" in problem for problem in recording.problems)
    assert any("steps are missing: ticks" in problem for problem in recording.problems)
    assert 0 < len(recording.steps) < len(whole.steps)


def test_a_torn_line_of_the_log_is_reported(tmp_path: Path) -> None:
    folder = sessions.small_session(tmp_path, steps=3)
    log = folder / "trials.jsonl"
    log.write_bytes(log.read_bytes()[:-20])
    session = read_session(folder)
    assert session.problems == ("the last line of trials.jsonl was cut off (" + session.problems[0].split("(")[1],)
    assert session.log[-1].event == "trial_ended"
    lines = log.read_bytes().split(b"\n")
    log.write_bytes(b"\n".join([lines[0], b"\x00\xff rubbish", *lines[2:]]))
    assert any("line 2 of trials.jsonl is damaged" in problem for problem in read_session(folder).problems)


def _small_file(tmp_path: Path):
    """An attempt's file of several chunks with tiny pictures, and what it holds."""
    writer = sessions.open_writer(tmp_path / "recordings")
    writer.begin_trial(1, 7)
    writer.begin_attempt(1, "base")
    for tick in range(6):
        small = values.observation(tick, 1000.0 + tick, size=16)
        writer.add_step(values.step(tick, observation=small))
        if tick % 2:
            time.sleep(0.4)
    writer.abandon_attempt("enough")
    writer.close()
    file = writer.folder / "trial_0001/attempt_1.mcap"
    return file, read_attempt(file)
