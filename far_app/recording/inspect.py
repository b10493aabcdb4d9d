"""What a session holds and what is missing or damaged: `far inspect PATH --json`, or a table for people."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from far_app.errors import RecordingError
from far_app.recording.attempt_reader import AttemptRecording, read_attempt
from far_app.recording.codec import Json, plain
from far_app.recording.reader import SessionRecording, read_session
from far_app.recording.schema import SESSION_FILE, TRIALS_FILE, LogEntry
from far_app.recording.session_folder import attempt_name
from far_app.types import Outcome


@dataclass(frozen=True, kw_only=True)
class AttemptReport:
    attempt: int
    file: str
    """Relative to the session's folder."""
    outcome: str
    """"success", "failure", "abandoned" or "none" (cut off)."""
    judged_by: str
    note: str
    """The judge's, or why the attempt was abandoned."""
    policy_version: str
    steps: int
    duration_s: float
    starved: int
    late_ms_max: float
    chunks: int
    frames: dict[str, int]
    """Readable frames by camera."""
    flagged: int
    adaptation: str
    """Status of the adaptation that followed; "" without one."""
    pairs: int
    bytes: int
    closed: bool
    damaged: bool
    problems: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class TrialReport:
    trial: int
    scene_seed: int | None
    success: bool
    judged_by: str
    ended: bool
    attempts: tuple[AttemptReport, ...]


@dataclass(frozen=True, kw_only=True)
class SessionReport:
    path: str
    schema_version: int
    session: str
    started: str
    task: str
    method: str
    policy: str
    code_version: str
    state: str
    """"closed" (in order), "recording" (a living process writes it), "failed" (the recorder gave up) or "cut off"."""
    sound: bool
    """Nothing is missing or damaged."""
    bytes: int
    trials: tuple[TrialReport, ...]
    problems: tuple[str, ...]
    """Of the session and of every attempt, each with where it is."""

    def to_json(self) -> Json:
        return plain(self)


def inspect_session(path: Path) -> SessionReport:
    """Reads every file of a session whole. Raises RecordingError when there is no session or one of another schema."""
    session = read_session(path)
    events = _events(session)
    attempts: dict[int, list[AttemptReport]] = {}
    problems = list(session.problems)
    for file in session.files:
        name = str(file.relative_to(session.path))
        try:
            recording = read_attempt(file)
        except RecordingError as error:
            problems.append(f"{name}: {error}")
            continue
        trial, number = _place(file)
        report = _attempt_report(recording, name, number, session.marks.get((trial, number)))
        log_problems = [] if session.live else _compare(report, trial, events)
        report = dataclasses.replace(report, problems=(*report.problems, *log_problems))
        problems.extend(f"{name}: {problem}" for problem in report.problems)
        attempts.setdefault(trial, []).append(report)
    problems.extend(_missing_files(session))
    state = _state(session)
    if state in ("cut off", "failed"):
        reasons = [entry.text for entry in session.log if entry.event == "recording_failed"]
        problems.append(f"the session was not closed in order{': ' + reasons[-1] if reasons else ''}")
    trials = sorted({*attempts, *(entry.trial for entry in session.log if entry.event == "trial_started")})
    header = session.header
    return SessionReport(
        path=str(path), schema_version=header.schema_version, session=header.session, started=header.started,
        task=header.info.task, method=header.info.method, policy=header.info.policy, code_version=header.code_version,
        state=state, sound=not problems, bytes=sum(f.stat().st_size for f in path.rglob("*") if f.is_file()),
        trials=tuple(_trial_report(trial, attempts.get(trial, []), events) for trial in trials),
        problems=tuple(problems),
    )  # fmt: skip


def table(report: SessionReport) -> str:
    """The report for people."""
    lines = [
        f"{report.session}   {report.task}, {report.method}   {report.started}   {report.bytes / 1e6:.1f} MB   "
        f"{report.state}",
        "",
        f"{'trial':>5} {'scene':>7} {'attempt':>7}  {'outcome':<9} {'judged by':<9} {'steps':>5} {'seconds':>7} "
        f"{'starved':>7} {'flagged':>7} {'pairs':>5}  {'adaptation':<10} policy",
    ]
    for trial in report.trials:
        scene = "" if trial.scene_seed is None else str(trial.scene_seed)
        if not trial.attempts:
            lines.append(f"{trial.trial:>5} {scene:>7} {'–':>7}  none")
        for a in trial.attempts:
            lines.append(
                f"{trial.trial:>5} {scene:>7} {a.attempt:>7}  {a.outcome:<9} {a.judged_by:<9} {a.steps:>5} "
                f"{a.duration_s:>7.1f} {a.starved:>7} {a.flagged:>7} {a.pairs:>5}  {a.adaptation:<10} "
                f"{a.policy_version}{'  !' if a.problems else ''}"
            )
    done = [trial for trial in report.trials if trial.ended]
    lines += ["", f"{sum(trial.success for trial in done)} of {len(done)} ended trials succeeded"]
    lines += [f"! {problem}" for problem in report.problems] or ["nothing is missing or damaged"]
    return "\n".join(lines)


def find_session(path: Path) -> Path:
    """The session's folder of a path inside it, or the newest session of a folder of sessions."""
    for folder in (path, *path.parents[:2]):
        if (folder / SESSION_FILE).exists():
            return folder
    sessions = sorted((p.parent for p in path.glob(f"*/{SESSION_FILE}")), key=_started) if path.is_dir() else []
    if not sessions:
        raise RecordingError(
            f"{path} {'holds no session' if path.exists() else 'does not exist'}; give a session's folder, "
            "such as recordings/sample"
        )
    return sessions[-1]


def _started(session: Path) -> float:
    """Seconds since 1970; 0 when the session does not say."""
    try:
        header = json.loads((session / SESSION_FILE).read_text(encoding="utf-8"))
        return datetime.fromisoformat(header["started"]).timestamp()
    except (OSError, ValueError, KeyError, TypeError):
        return 0.0


def inspect_command(path: Path, as_json: bool) -> tuple[str, int]:
    """What `far inspect` prints and its exit status: 0 when the session could be read, however much is missing.
    Raises RecordingError when it could not."""
    report = inspect_session(find_session(path))
    return (json.dumps(report.to_json(), indent=2, ensure_ascii=False) if as_json else table(report)), 0


def _attempt_report(recording: AttemptRecording, name: str, number: int, mark: Outcome | None) -> AttemptReport:
    outcome, adaptation, header = mark or recording.outcome, recording.adaptation, recording.header
    late = [1e3 * step.lateness for step in recording.steps if step.lateness == step.lateness]
    return AttemptReport(
        attempt=number, file=name,
        outcome=_word(outcome, recording),
        judged_by=outcome.judged_by.value if outcome else "", note=outcome.note if outcome else recording.abandoned,
        policy_version=header.policy_version if header else "", steps=len(recording.steps),
        duration_s=round(recording.duration, 3), starved=sum(step.starved for step in recording.steps),
        late_ms_max=round(max(late), 3) if late else float("nan"), chunks=len(recording.chunks),
        frames=recording.frames, flagged=len(adaptation.flagged) if adaptation else 0,
        adaptation=adaptation.status if adaptation else "", pairs=adaptation.pairs if adaptation else 0,
        bytes=recording.size, closed=recording.closed, damaged=recording.damaged, problems=recording.problems,
    )  # fmt: skip


def _word(outcome: Outcome | None, recording: AttemptRecording) -> str:
    if outcome is not None:
        return "success" if outcome.success else "failure"
    return "abandoned" if recording.abandoned else "none"


def _trial_report(
    trial: int, attempts: Sequence[AttemptReport], events: dict[tuple[str, int, int], LogEntry]
) -> TrialReport:
    attempts = sorted(attempts, key=lambda report: report.attempt)
    started, ended = events.get(("trial_started", trial, 0)), ("trial_ended", trial, 0) in events
    last = attempts[-1] if attempts else None
    return TrialReport(
        trial=trial, scene_seed=started.detail.get("scene_seed") if started else None,
        success=last is not None and last.outcome == "success", judged_by=last.judged_by if last else "",
        ended=ended, attempts=tuple(attempts),
    )  # fmt: skip


def _compare(report: AttemptReport, trial: int, events: dict[tuple[str, int, int], LogEntry]) -> list[str]:
    """Where an attempt's file and trials.jsonl disagree."""
    key = (trial, report.attempt)
    if ("attempt_started", *key) not in events:
        return [f"{TRIALS_FILE} does not know of it"]
    ended = events.get(("attempt_ended", *key)) or events.get(("attempt_abandoned", *key))
    if ended is not None and ended.detail.get("steps") != report.steps:
        return [f"{report.steps} of {ended.detail.get('steps')} steps are readable"]
    adapted = events.get(("adapted", *key))
    return ["its adaptation is missing"] if adapted is not None and not report.adaptation else []


def _missing_files(session: SessionRecording) -> list[str]:
    there = {str(file.relative_to(session.path)) for file in session.files}
    known = [attempt_name(entry.trial, entry.attempt) for entry in session.log if entry.event == "attempt_started"]
    weights = [str(entry.detail.get("file")) for entry in session.log if entry.event == "weights_kept"]
    there |= {name for name in weights if (session.path / name).exists()}
    return [f"{name} is missing" for name in (*known, *weights) if name not in there]


def _events(session: SessionRecording) -> dict[tuple[str, int, int], LogEntry]:
    """(event, trial, attempt) to its newest line; trial events without the attempt."""
    whole_trial = ("trial_started", "trial_ended")
    return {(e.event, e.trial, 0 if e.event in whole_trial else e.attempt): e for e in session.log}


def _state(session: SessionRecording) -> str:
    if session.live:
        return "recording"
    names = [entry.event for entry in session.log]
    if "recording_failed" in names:
        return "failed"
    return "closed" if "session_ended" in names else "cut off"


def _place(file: Path) -> tuple[int, int]:
    """Trial and attempt of a file, from its name."""
    trial, attempt = file.parent.name.removeprefix("trial_"), file.stem.removeprefix("attempt_")
    return int(trial) if trial.isdigit() else 0, int(attempt) if attempt.isdigit() else 0
