"""A recorded session reads back whole."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from PIL import Image

from far_app.errors import RecordingError
from far_app.recording.attempt_reader import read_attempt
from far_app.recording.images import decode_png, encode_png, stored_png
from far_app.recording.reader import read_session
from far_app.types import AdaptationStep, Judge, Outcome

from . import sessions, values


def test_a_round_trip_loses_nothing(tmp_path: Path) -> None:
    writer = sessions.open_writer(tmp_path)
    attempt, retry = values.attempt(1, 12), values.attempt(2, 9, start=2000.0, success=True)
    chunks = [values.chunk(tick, candidates=4 * (tick == 3)) for tick in range(12)]
    progress = [AdaptationStep(step=k, steps=2, loss=0.7, winner_error=1.0, loser_error=2.0) for k in range(2)]
    writer.begin_trial(1, 7)
    writer.begin_attempt(1, "base")
    for step, chunk in zip(attempt.steps[:-2], chunks, strict=False):
        writer.add_chunk(chunk)
        writer.add_step(step)
        writer.add_step(step)  # a paused driver gives the same step again
    for chunk in chunks[10:]:
        writer.add_chunk(chunk)
    times = [values.tick_times(tick) for tick in range(13)]
    for tick in times:
        writer.add_tick_times(tick)
    writer.event("paused", "by the operator", {"tick": 4})
    writer.end_attempt(attempt)
    for step in progress:
        writer.add_adaptation_step(step)
    writer.add_adaptation(values.adaptation(12))
    writer.begin_attempt(2, "base")
    writer.end_attempt(retry)
    writer.end_trial(success=True, attempts=2)
    writer.close("all done")
    writer.close()

    session = read_session(writer.folder)
    first, second = session.attempts()
    assert session.problems == first.problems == second.problems == ()
    assert session.header == writer.header
    assert first.closed and second.closed and not session.live
    assert values.same(first.attempt(), attempt)
    assert values.same(second.attempt(), retry)
    assert values.same(first.chunks, tuple(chunks))
    assert first.tick_times == tuple(times) and second.tick_times == ()
    assert values.same(first.adaptation, values.adaptation(12))
    assert first.adaptation_steps == tuple(progress)
    assert [(e.event, e.text, e.detail) for e in first.events] == [("paused", "by the operator", {"tick": 4})]
    assert first.frames == {"front": 13, "wrist": 13}
    assert session.log[-1].event == "session_ended" and session.log[-1].text == "all done"


def test_attempts_of_a_trial_are_linked(tmp_path: Path) -> None:
    session = read_session(sessions.small_session(tmp_path))
    first, second = (recording.header for recording in session.attempts())
    assert first is not None and second is not None
    assert (first.previous, second.previous) == ("", "trial_0001/attempt_1.mcap")
    assert (first.scene_seed, second.scene_seed) == (7, 7)
    assert first.session == session.path.name
    assert (session.path / second.previous).exists()


def test_a_frame_seen_by_many_ticks_is_written_once(tmp_path: Path) -> None:
    writer = sessions.open_writer(tmp_path)
    still = values.observation(3, 1000.0)
    steps = tuple(values.step(tick, observation=still) for tick in range(6))
    writer.begin_trial(1, 7)
    writer.begin_attempt(1, "base")
    for step in steps:
        writer.add_step(step)
    writer.abandon_attempt("enough")
    writer.close()
    recording = read_attempt(writer.folder / "trial_0001/attempt_1.mcap")
    assert recording.frames == {"front": 1, "wrist": 1}
    assert values.same(recording.steps, steps)
    assert (recording.abandoned, recording.problems) == ("enough", ())


def test_an_operators_word_stands_beside_the_programs_own(tmp_path: Path) -> None:
    writer = sessions.open_writer(tmp_path)
    word = Outcome(success=True, judged_by=Judge.OPERATOR, note="it was up")
    writer.begin_trial(1, 7)
    for index in (1, 2):
        writer.begin_attempt(index, "base")
        writer.end_attempt(values.attempt(index, 3))
    writer.mark(word)
    writer.end_trial(success=True, attempts=2)
    writer.mark(word, trial=1, attempt=1)
    writer.close()
    session = read_session(writer.folder)
    first, second = session.attempts()
    assert [outcome.judged_by for outcome in second.outcomes] == [Judge.HORIZON, Judge.OPERATOR]
    assert first.outcome == Outcome(success=False, judged_by=Judge.HORIZON)
    assert session.marks == {(1, 1): word, (1, 2): word}


def test_the_mcap_library_reads_the_file_by_its_index(tmp_path: Path) -> None:
    file = sessions.small_session(tmp_path, steps=5) / "trial_0001/attempt_1.mcap"
    reader = make_reader(io.BytesIO(file.read_bytes()), validate_crcs=True)
    found = {}
    for schema, channel, message in reader.iter_messages():
        assert schema is not None and schema.encoding == "jsonschema" and channel.message_encoding == "json"
        body = json.loads(message.data)
        assert set(body) <= set(json.loads(schema.data)["properties"]), channel.topic
        found.setdefault(channel.topic, []).append(body)
    assert {topic: len(bodies) for topic, bodies in found.items()} == {
        "/attempt": 1, "/step": 5, "/chunk": 5, "/camera/front": 6, "/camera/wrist": 6, "/final": 1, "/outcome": 1,
        "/adaptation": 1,
    }  # fmt: skip
    assert [step["observation"]["frames"]["front"] for step in found["/step"]] == [0, 1, 2, 3, 4]


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_frames_are_lossless(height: int, width: int, seed: int) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    for png in (encode_png(image), stored_png(image)):
        np.testing.assert_array_equal(decode_png(png), image)
        np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(png))), image)


def test_frames_of_another_kind_are_refused() -> None:
    for frame in (np.zeros((4, 4, 3)), np.zeros((4, 4), np.uint8), np.zeros((4, 4, 4), np.uint8)):
        for encode in (encode_png, stored_png):
            with pytest.raises(RecordingError, match="frames are uint8 H × W × 3"):
                encode(frame)


def test_a_session_never_overwrites_another(tmp_path: Path) -> None:
    writers = [sessions.open_writer(tmp_path) for _ in range(3)]
    for writer in writers:
        writer.close()
    assert len({writer.folder for writer in writers}) == 3
