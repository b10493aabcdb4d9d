"""No process of the page outlives the one that started it."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Callable

PR_SET_PDEATHSIG = 1


def die_with_parent(number: signal.Signals = signal.SIGTERM) -> Callable[[], bool]:
    """Linux: send us this signal when our parent dies, even by SIGKILL. The returned function says whether it is gone,
    for other systems and for a parent that died before we asked."""
    parent = os.getppid()
    _LIBC.prctl(PR_SET_PDEATHSIG, number) if _LIBC is not None else None
    return lambda: os.getppid() != parent


def killed_with_parent() -> None:
    """As a child's preexec_fn: SIGKILL at the parent's death, for programs that are not ours."""
    if _LIBC is not None:
        _LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


_LIBC = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None
