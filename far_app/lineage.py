"""Policy versions of a session and what came from what; what an operator may ask of them.

A version is named by its trial and its own name ("3:base+a1"); "base" is the policy the session began with. Values for
the page and the wire; far_app/session/versions.py keeps them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from far_app.wire import register

BASE = "base"
"""The policy the session began with."""


@register
class Wish(StrEnum):
    UNDO = "undo"
    """The next attempt starts from the weights before the last adaptation."""
    RESTORE = "restore"
    """The next attempt acts with this version."""
    KEEP = "keep"
    """Coming trials begin with this version."""


@register
@dataclass(frozen=True, kw_only=True)
class VersionWish:
    """From the page to the app."""

    wish: Wish
    version: str = ""
    """For RESTORE and KEEP."""
    by: str = ""


@register
@dataclass(frozen=True, kw_only=True)
class PolicyRow:
    """One version."""

    name: str
    parent: str
    """The version it was made from; empty for the base."""
    trial: int = 0
    attempt: int = 0
    """The failure it was learnt from."""
    pairs: int = 0
    acted: int = 0
    """Attempts that ended under it."""
    solved: int = 0


@register
@dataclass(frozen=True, kw_only=True)
class Versions:
    """What the page is told of them."""

    rows: tuple[PolicyRow, ...] = ()
    """Oldest first; the newest 100 adaptations."""
    acting: str = ""
    base: str = BASE
    """With which trials begin."""
    next: str = ""
    """What the operator asked for; "" when nothing is pending."""
    undo: str = ""
    """The version an undo would lead to; "" when there is nothing to undo."""
    unavailable: str = ""
    """Why versions cannot be chosen in this session."""


def ancestry(rows: tuple[PolicyRow, ...], name: str) -> tuple[str, ...]:
    """The version and what it came from, back to the base."""
    parents = {row.name: row.parent for row in rows}
    line = [name]
    while (parent := parents.get(line[-1], "")) and parent not in line:
        line.append(parent)
    return tuple(line)
