"""`python -m far_app.cli.rrd SESSION`: each attempt's .rrd as soon as its recording is closed, at the lowest priority.

Started by `far run` beside a session, headless too. On SIGTERM it makes what is still lacking and ends; when its parent
dies it ends at once.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
from pathlib import Path

from far_app.errors import RecordingError
from far_app.parent import die_with_parent
from far_app.recording.replay import lacking_rrd, make_rrd
from far_app.signal_event import SignalSafeEvent

log = logging.getLogger(__name__)

LOOK = 1.0
"""Seconds between two looks at the session."""


def main() -> int:
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    ended = SignalSafeEvent().set_on(signal.SIGTERM)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    orphaned = die_with_parent()
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, 15)
    session, refused = Path(sys.argv[1]), set[Path]()
    last = False
    while not last and not orphaned():
        last = ended.wait(LOOK)
        for attempt in lacking_rrd(session):
            if attempt in refused or orphaned():
                continue
            from ui.rerun_views import attempt_to_rrd  # takes long, and an attempt takes longer

            try:
                make_rrd(attempt, attempt_to_rrd)
            except RecordingError as error:
                refused.add(attempt)
                log.warning("%s", error)
    return 0


if __name__ == "__main__":
    sys.exit(main())
