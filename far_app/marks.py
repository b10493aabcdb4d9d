"""A person's word on an attempt: success, failure, unsure, a note. The program's own judgment stays beside it.

Append-only: each word is kept with who and when; the last verdict counts. Read back by far_app/recording/marks.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from far_app.wire import register

NOTE_LIMIT = 500
"""Characters of a note."""


@register
class Verdict(StrEnum):
    SUCCESS = "success"
    FAILURE = "failure"
    UNSURE = "unsure"
    """It is in no figure, and no success to export."""


@register
@dataclass(frozen=True, kw_only=True)
class Mark:
    """One word on one attempt."""

    trial: int
    attempt: int
    verdict: Verdict | None = None
    """None: a note alone, which changes no verdict."""
    note: str = ""
    by: str = ""
    wall: str = ""
    """ISO 8601 with the offset to UTC."""


@register
@dataclass(frozen=True, kw_only=True)
class MarkAttempt:
    """From the page to whoever keeps the session."""

    session: str
    mark: Mark


@register
@dataclass(frozen=True, kw_only=True)
class Judged:
    """An attempt of the history: the program's judgment, and the last word of a person beside it."""

    trial: int
    attempt: int
    success: bool
    judged_by: str
    policy_version: str = ""
    verdict: Verdict | None = None
    note: str = ""
    by: str = ""

    @property
    def final(self) -> bool | None:
        """Success or failure by the last word; None where a person is unsure."""
        if self.verdict is None:
            return self.success
        return None if self.verdict is Verdict.UNSURE else self.verdict is Verdict.SUCCESS


def trouble(mark: Mark) -> str:
    """Why a mark cannot be kept; empty when it can."""
    if mark.trial < 1 or mark.attempt < 1:
        return f"trial {mark.trial}, attempt {mark.attempt} is no attempt; both count from 1"
    if len(mark.note) > NOTE_LIMIT:
        return f"the note has {len(mark.note)} characters, at most {NOTE_LIMIT} are kept; shorten it"
    if mark.verdict is None and not mark.note.strip():
        return "neither a verdict nor a note was given"
    return ""
