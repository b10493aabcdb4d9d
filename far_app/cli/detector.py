"""`far run --detector` and `--alarm`: what was learnt or calibrated for a policy, put together with it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from far_app.alarm import Alarm, FailureAlarm, read_limits
from far_app.attempt import NO_ALARM
from far_app.cli.assemble import checkpoints
from far_app.protocols import SuccessDetector

if TYPE_CHECKING:
    from far_app.cli.options import RunOptions


@contextlib.contextmanager
def learned_detector(options: RunOptions, wait: float) -> Iterator[SuccessDetector]:
    """The detector that was asked for, looking in a thread of its own through the policy's frozen encoder; `wait`:
    seconds for the operator's word when it is unsure. Raises CheckpointError."""
    from far_app.learning.policy import load_policy
    from far_app.learning.success import load_detector
    from far_app.session.watching import WatchingDetector

    assert options.detector is not None, "asked for without one"
    path, _ = checkpoints(options.task, Path(options.policy) if options.policy else None, None)
    learned = load_detector(options.detector, load_policy(path, options.task, options.device), wait)
    detector = WatchingDetector(learned, wait)
    try:
        yield detector
    finally:
        detector.close()


def failure_alarm(options: RunOptions) -> Alarm:
    """The early failure alarm that was asked for. Raises ConfigError or CheckpointError."""
    if options.alarm is None:
        return NO_ALARM
    from far_app.learning.policy import fingerprint, load_policy

    path, _ = checkpoints(options.task, Path(options.policy) if options.policy else None, None)
    return FailureAlarm(read_limits(options.alarm, fingerprint(load_policy(path, options.task))))
