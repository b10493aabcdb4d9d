"""An older recording reads as if it were written today; what cannot be lifted is refused by its version."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from far_app.errors import RecordingError
from far_app.recording import migrations
from far_app.recording.attempt_reader import read_attempt
from far_app.recording.inspect import inspect_session
from far_app.recording.migrations import MIGRATIONS, VERSIONS, migrated, readable
from far_app.recording.reader import read_session
from far_app.recording.schema import SCHEMA_VERSION

from . import sessions

SAMPLE = Path(__file__).resolve().parents[2] / "recordings/sample"


def as_schema_1(topic: str, body: dict[str, Any]) -> dict[str, Any]:
    """What schema 1 wrote where today's writes this."""
    if topic == "/step":
        body.pop("intervention", None)
    return {**body, "schema_version": 1} if "schema_version" in body else body


def lowered(folder: Path, lower: Callable[[str, dict[str, Any]], dict[str, Any]]) -> None:
    """Rewrite a session as an older program would have written it."""
    file = folder / "session.json"
    file.write_text(json.dumps(lower("session.json", json.loads(file.read_text()))))
    for file in folder.glob("trial_*/attempt_*.mcap"):
        with file.open("rb") as source:
            messages = [(s, c, m) for s, c, m in make_reader(source).iter_messages()]
        with file.open("wb") as target:
            writer = Writer(target)
            writer.start()
            channels: dict[str, int] = {}
            for schema, channel, message in messages:
                if channel.topic not in channels:
                    known = writer.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
                    channels[channel.topic] = writer.register_channel(channel.topic, "json", known)
                data = json.dumps(lower(channel.topic, json.loads(message.data))).encode()
                at = channels[channel.topic]
                writer.add_message(at, message.log_time, data, message.publish_time, message.sequence)
            writer.finish()


def test_every_version_is_told_of_and_can_be_lifted_to_the_next() -> None:
    assert list(VERSIONS) == list(range(1, SCHEMA_VERSION + 1))
    assert list(MIGRATIONS) == list(range(1, SCHEMA_VERSION))


def test_a_session_of_schema_1_reads_as_today_s(tmp_path: Path) -> None:
    folder = sessions.small_session(tmp_path)
    today = read_session(folder)
    attempts = [read_attempt(file) for file in today.files]
    lowered(folder, as_schema_1)
    old = read_session(folder)
    assert old.header == replace(today.header, schema_version=1) and old.log == today.log
    for file, attempt in zip(old.files, attempts, strict=True):
        read = read_attempt(file)
        assert not read.problems and read.header is not None and attempt.header is not None
        assert read.header == replace(attempt.header, schema_version=1)
        assert [step.tick for step in read.steps] == [step.tick for step in attempt.steps]
        assert read.outcomes == attempt.outcomes
    assert inspect_session(folder).sound


def test_before_take_over_existed_every_step_was_the_policy_s() -> None:
    assert migrated("/step", {"tick": 3}, 1) == {"tick": 3, "intervention": False}
    assert migrated("/step", {"intervention": True}, SCHEMA_VERSION) == {"intervention": True}
    assert migrated("/chunk", {"tick": 3}, 1) == {"tick": 3}


def test_a_recording_is_lifted_through_every_version_between(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Today's session under a program two versions on."""
    folder = sessions.small_session(tmp_path, steps=3)
    lifts = {
        **MIGRATIONS,
        SCHEMA_VERSION: {"session.json": lambda body: {**body, "host": {"note": "once"}}},
        SCHEMA_VERSION + 1: {"session.json": lambda body: {**body, "host": {"note": body["host"]["note"] + ", twice"}}},
    }
    monkeypatch.setattr(migrations, "MIGRATIONS", lifts)
    monkeypatch.setattr(migrations, "SCHEMA_VERSION", SCHEMA_VERSION + 2)
    assert read_session(folder).header.host == {"note": "once, twice"}


@pytest.mark.parametrize("version", [0, SCHEMA_VERSION + 1, "1", None, True, 1.5])
def test_a_version_that_nothing_lifts_is_refused_by_name(version: object, tmp_path: Path) -> None:
    folder = sessions.small_session(tmp_path, steps=2)
    lowered(folder, lambda topic, body: {**body, "schema_version": version} if "schema_version" in body else body)
    for read, path in ((read_session, folder), (read_attempt, folder / "trial_0001/attempt_1.mcap")):
        with pytest.raises(RecordingError, match=f"schema version {version}, .* reads versions 1 to {SCHEMA_VERSION}"):
            read(path)


def test_a_step_that_no_lift_fits_is_counted_and_the_rest_is_read(tmp_path: Path) -> None:
    folder = sessions.small_session(tmp_path, steps=5)
    lowered(folder, lambda topic, body: [1] if topic == "/step" and body["tick"] == 2 else as_schema_1(topic, body))  # type: ignore[return-value]
    read = read_attempt(folder / "trial_0001/attempt_1.mcap")
    assert [step.tick for step in read.steps] == [0, 1, 3, 4]
    assert any("do not fit their schema" in problem for problem in read.problems)


def test_the_session_that_comes_with_the_program_is_of_schema_1_and_opens() -> None:
    session = read_session(SAMPLE)
    assert readable(session.header.schema_version, SAMPLE) == 1
    assert all(not read_attempt(file).problems for file in session.files)
