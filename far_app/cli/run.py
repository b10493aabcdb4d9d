"""`far run`: the whole application."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from far_app.cli.options import RunOptions
from far_app.cli.settings import parse
from far_app.cli.stage import Stage, stage
from far_app.config import RetryConfig
from far_app.endpoints import Endpoints
from far_app.errors import ConfigError
from far_app.recording.writer import SessionWriter
from far_app.session.course import Course
from far_app.session.inbox import IntentInbox
from far_app.session.settings import TrialResult
from far_app.session.statistics import LoopStatistics
from far_app.session.supervision import SessionFault
from far_app.session_states import Intent


def main(arguments: Sequence[str]) -> int:
    options = parse(RunOptions, arguments, "far run", on_this_robot)
    logging.basicConfig(
        level=logging.INFO if options.verbose else logging.WARNING,
        format="%(asctime)s %(levelname)s %(name)s: %(message)s",
    )
    if options.summary_json is not None:
        check_writable(options.summary_json)
    results, statistics = run(options)
    if options.summary_json is not None:
        write_json(options.summary_json, {"trials": [told(r) for r in results], **statistics.summary()})
    counted = [r for r in results if r.counted]
    apart = f"; {len(results) - len(counted)} that began at reduced speed, or with a person's help, not counted" * (
        counted != results
    )
    print(f"{sum(r.success for r in counted)} of {len(counted)} trials succeeded{apart}", flush=True)
    return 0


def on_this_robot(options: RunOptions, retry: RetryConfig) -> RetryConfig:
    """Settings of the method as a real arm gets them unless told otherwise: perturbation smoothed, and only of x, y, z
    (paper, Real-world Experiments)."""
    if options.load_rig().robot != "xarm":
        return retry
    return dataclasses.replace(
        retry, perturbation=dataclasses.replace(retry.perturbation, kind="smoothed", dims=(0, 1, 2))
    )


def told(result: TrialResult) -> dict[str, Any]:
    """A trial in the summary; that it does not count is said where it does not."""
    fields = {name: getattr(result, name) for name in ("seed", "attempts", "success", "judged_by")}
    return fields if result.counted else {**fields, "counted": False}


def run(options: RunOptions) -> tuple[list[TrialResult], LoopStatistics]:
    """One session. Raises the FarError that ended it; the arm is held and the recording closed by then."""
    statistics = LoopStatistics()
    with Ending() as ending, stage(options) as stage_:
        return supervise(stage_, stage_.writer(), ending, statistics), statistics


def supervise(
    stage_: Stage, writer: SessionWriter, ending: Ending, statistics: LoopStatistics, course: Course | None = None
) -> list[TrialResult]:
    """Run the session on a stage that stands. Raises the FarError that ended it."""
    if stage_.page_url:
        print(f"The operator page is at {stage_.page_url}", flush=True)
    print(f"Recording to {writer.folder}", flush=True)
    inbox = IntentInbox(Endpoints.in_folder(stage_.folder).intents)
    ending.tell(inbox)
    try:
        with stage_.session(writer, inbox, statistics, course=course) as session:
            session.run()
    except SessionFault as fault:
        if stage_.hardware is not None:
            stage_.hardware.check(f"{fault}; ")
        raise
    finally:
        inbox.close()
    if session.recorder.error is not None:
        raise session.recorder.error
    return session.results


class Ending(contextlib.AbstractContextManager["Ending"]):
    """Ctrl-C and SIGTERM: at once while starting; once the session runs, the operator's QUIT (arm held, recording
    closed). A second signal cuts the waiting short."""

    def __init__(self) -> None:
        self._inbox: IntentInbox | None = None
        self._signals = 0

    def __enter__(self) -> Ending:
        self._before = {n: signal.signal(n, self._hear) for n in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def tell(self, inbox: IntentInbox) -> None:
        """From now on a signal is a QUIT."""
        self._inbox = inbox

    def _hear(self, *_: object) -> None:
        self._signals += 1
        if self._inbox is None or self._signals > 1:
            raise KeyboardInterrupt
        self._inbox.put(Intent.QUIT)


def check_writable(path: Path) -> None:
    """An error now instead of after an hour."""
    if not path.parent.is_dir():
        raise ConfigError(f"the folder of {path} does not exist; make it or give another path")


def write_json(path: Path, value: dict[str, Any]) -> None:
    path.write_text(json.dumps(value, indent=2) + "\n")
