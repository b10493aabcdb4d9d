"""How a background adaptation is told to end: it looks at `cancelled` before every pass of the denoiser."""

from __future__ import annotations

from collections.abc import Callable

Cancelled = Callable[[], bool]
"""True once nobody waits for the result any more."""


class AdaptationCancelledError(Exception):
    """Unwinds an adaptation that nobody waits for; never leaves Method.adapt."""


def check(cancelled: Cancelled) -> None:
    """Raise when the adaptation is no longer wanted. Called between batches, some 20 ms apart."""
    if cancelled():
        raise AdaptationCancelledError


def never() -> bool:
    return False
