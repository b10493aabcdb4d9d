"""Recordings of older schemas, read as if they were written today; the files themselves are never rewritten.

MIGRATIONS[n] lifts what schema n wrote to schema n + 1: JSON body by JSON body, by where it stood. The readers call
it before anything is decoded. To raise SCHEMA_VERSION: say in VERSIONS what is new, and add the lift from the version
before; tests/recording/test_migrations.py fails while one is missing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from far_app.errors import RecordingError
from far_app.recording.codec import Json
from far_app.recording.schema import SCHEMA_VERSION

VERSIONS: Mapping[int, str] = {
    1: "the first",
    2: "a step says whether a person led the arm (`intervention`); a program that knows nothing of it would take a "
    "person's steps for the policy's",
}
"""What each version brought."""

Lift = Callable[[Json], Json]


def _by_the_policy(step: Json) -> Json:
    """Before take-over existed every step was the policy's."""
    return {"intervention": False, **step}


MIGRATIONS: Mapping[int, Mapping[str, Lift]] = {1: {"/step": _by_the_policy}}
"""Version to lifts by place: a topic of an attempt's file, session.json or trials.jsonl; what is not named stays."""


def readable(version: object, path: Path) -> int:
    """The version, if it is today's or can be lifted to it. Raises RecordingError that names it otherwise."""
    number = version if isinstance(version, int) and not isinstance(version, bool) else 0
    if min(MIGRATIONS) <= number <= SCHEMA_VERSION:
        return number
    newer = number > SCHEMA_VERSION
    what = "newer than this program: update it, or" if newer else "which nothing here can lift to today's;"
    raise RecordingError(
        f"{path} was recorded with schema version {version}, {what} open it with the program's version named in its "
        f"session.json (code_version); this program reads versions {min(MIGRATIONS)} to {SCHEMA_VERSION}"
    )


def migrated(place: str, body: Json, version: int) -> Json:
    """A body as today's schema has it. Whatever a damaged body makes a lift raise is for the caller to count."""
    for older in range(version, SCHEMA_VERSION):
        lift = MIGRATIONS[older].get(place)
        body = lift(body) if lift is not None else body
    return body
