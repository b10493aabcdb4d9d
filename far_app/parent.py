"""How a process of a run runs: to its parent's end and no longer, or until it is told."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import sys
from collections.abc import Callable, Sequence
from typing import TypeVar

from far_app.errors import FarError
from far_app.signal_event import SignalSafeEvent

log = logging.getLogger(__name__)

Options = TypeVar("Options")
"""What a process was told."""

PR_SET_PDEATHSIG = 1


def die_with_parent(number: signal.Signals = signal.SIGTERM) -> Callable[[], bool]:
    """Linux: send us this signal when our parent dies, even by SIGKILL. The returned function says whether it is gone,
    for other systems and for a parent that died before we asked."""
    parent = os.getppid()
    _LIBC.prctl(PR_SET_PDEATHSIG, number) if _LIBC is not None else None
    return lambda: os.getppid() != parent


def run_until_told(
    parse: Callable[[Sequence[str] | None], Options], serve: Callable[[Options, SignalSafeEvent], None],
    arguments: Sequence[str] | None,
) -> int:  # fmt: skip
    """The main of such a process: `serve` what was parsed until SIGTERM or SIGINT; 2 on a FarError, said in the log."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(levelname)s %(message)s")
    options, ended = parse(arguments), SignalSafeEvent().set_on(signal.SIGTERM, signal.SIGINT)
    try:
        serve(options, ended)
    except FarError as error:
        log.error("%s", error)
        return 2
    return 0


def killed_with_parent() -> None:
    """As a child's preexec_fn: SIGKILL at the parent's death, for programs that are not ours."""
    if _LIBC is not None:
        _LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


_LIBC = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None
