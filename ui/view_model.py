"""From telemetry to what the page says: pure functions, no viser, no sockets (called by ui/console.py, tested alone).

Colours carry no meaning alone: every tone comes with a word.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from far_app.session_states import Intent, State
from far_app.telemetry import HIDDEN, CameraHealth, Telemetry, TrialRow
from far_app.types import RobotMode, RobotStatus

SILENT_AFTER = 1.5
"""Seconds without a word after which the app or the hw server counts as silent."""


class Tone(StrEnum):
    """How a thing is to be taken; one colour each in style.css."""

    IDLE = "idle"
    RUN = "run"
    GOOD = "good"
    LEARN = "learn"
    WARN = "warn"
    BAD = "bad"


@dataclass(frozen=True, kw_only=True)
class Freshness:
    """Seconds since the app and the hw server were last heard; None when never."""

    app: float | None = None
    hw: float | None = None

    @property
    def app_silent(self) -> bool:
        return self.app is None or self.app > SILENT_AFTER

    @property
    def hw_silent(self) -> bool:
        return self.hw is None or self.hw > SILENT_AFTER


@dataclass(frozen=True, kw_only=True)
class Banner:
    """The head of the page."""

    word: str
    tone: Tone
    detail: str
    attempt: int = 0
    max_attempts: int = 0
    trial: str = "–"
    scene: str = "–"
    tick: int = 0
    horizon: int = 0
    policy: str = "–"
    method: str = "–"
    task: str = "–"


WORDS: dict[State, tuple[str, Tone]] = {
    State.READY: ("READY", Tone.IDLE),
    State.HOMING: ("GOING HOME", Tone.IDLE),
    State.RUNNING: ("RUNNING", Tone.RUN),
    State.TAKEN_OVER: ("TAKEN OVER", Tone.LEARN),
    State.PAUSED: ("PAUSED", Tone.WARN),
    State.ADAPTING: ("LEARNING", Tone.LEARN),
    State.TRIAL_DONE: ("TRIAL DONE", Tone.IDLE),
    State.AWAITING_SCENE: ("SET THE SCENE", Tone.WARN),
    State.REVIEWING: ("KEEP IT?", Tone.WARN),
    State.STOPPED: ("STOPPED", Tone.BAD),
    State.FAULT: ("FAULT", Tone.BAD),
    State.FINISHED: ("FINISHED", Tone.IDLE),
}


def banner(telemetry: Telemetry | None, fresh: Freshness) -> Banner:
    """State, where in the session we are, and one sentence why."""
    if telemetry is None:
        return Banner(word="WAITING", tone=Tone.WARN, detail="No word from the app yet: it is starting, or gone.")
    word, tone = WORDS[telemetry.state]
    detail = _detail(telemetry)
    if telemetry.state is State.TRIAL_DONE and telemetry.history:
        success = telemetry.history[-1].success
        word, tone = ("SUCCESS", Tone.GOOD) if success else ("NOT SOLVED", Tone.WARN)
    if fresh.app_silent:
        word, tone = "APP SILENT", Tone.BAD
        detail = f"No word from the app for {fresh.app or 0:.0f} s. STOP still reaches the arm directly."
    elif fresh.hw_silent and telemetry.state is not State.FINISHED:
        tone = Tone.BAD
        detail = "The hw server is silent: use the emergency stop at the arm if it moves."
    return Banner(
        word=word,
        tone=tone,
        detail=detail,
        attempt=telemetry.attempt,
        max_attempts=telemetry.max_attempts,
        trial=f"{telemetry.trial}/{telemetry.trials}" if telemetry.trials else f"{telemetry.trial}",
        scene=str(telemetry.scene_seed),
        tick=telemetry.tick,
        horizon=telemetry.horizon,
        policy=telemetry.policy_version or "–",
        method=telemetry.method or "–",
        task=telemetry.task or "–",
    )


def _detail(telemetry: Telemetry) -> str:
    t = telemetry
    if t.countdown > 0:
        return t.reason or f"Next attempt in {t.countdown:.0f} s. Pause to cancel."
    home = f"going home {100 * t.homing_progress:.0f} %"
    if t.state is State.ADAPTING and not t.reason:
        flagged = (
            _count(len(t.flagged), "chunk") + " flagged" if t.flagged else _STATUS.get(t.adaptation_status, ("",))[0]
        )
        parts = [f"Attempt {t.attempt} failed", flagged, home if t.homing_progress < 1 else "at home"]
        return " · ".join(part for part in parts if part)
    if t.reason:
        return t.reason
    return {
        State.READY: "Set up, nothing moves.",
        State.HOMING: f"{home.capitalize()}.",
        State.RUNNING: "First attempt, unperturbed." if t.attempt <= 1 else f"Retry {t.attempt - 1} after a failure.",
        State.TAKEN_OVER: f"A person has the arm ({t.steering.ticks} ticks); hand back to let the policy go on.",
        State.PAUSED: "Held by the operator; Resume goes on.",
        State.TRIAL_DONE: f"{home.capitalize()}." if 0 < t.homing_progress < 1 else "The next trial follows.",
        State.AWAITING_SCENE: "Rebuild the scene, clear the workspace, then press Scene ready.",
        State.REVIEWING: "Keep the demonstration, discard it, or record it again.",
        State.STOPPED: "The arm is latched; Resume when it is safe to move.",
        State.FAULT: "The arm is held; Resume clears the fault when its cause is gone.",
        State.FINISHED: "All trials are done.",
    }[t.state]


@dataclass(frozen=True, kw_only=True)
class Control:
    """One button: may it act now, and if not, why."""

    enabled: bool
    reason: str = ""


_ATTEMPT_ONLY = "only during an attempt"
_NO_DEMO = "no demonstration waits"
_REASONS: dict[Intent, str] = {
    Intent.PAUSE: "nothing is running",
    Intent.RESUME: "nothing is held",
    Intent.MARK_SUCCESS: _ATTEMPT_ONLY,
    Intent.MARK_FAILURE: _ATTEMPT_ONLY,
    Intent.SKIP_TRIAL: "no trial under way",
    Intent.TAKE_OVER: _ATTEMPT_ONLY,
    Intent.HAND_BACK: "the policy has the arm",
    Intent.SCENE_READY: "no scene is awaited",
    Intent.KEEP: _NO_DEMO,
    Intent.DISCARD: _NO_DEMO,
    Intent.RECORD_AGAIN: _NO_DEMO,
    Intent.QUIT: "already finished",
}


def control(intent: Intent, telemetry: Telemetry | None, fresh: Freshness) -> Control:
    """Whether a button applies now. STOP always does."""
    if intent is Intent.STOP:
        return Control(enabled=True)
    if telemetry is None:
        return Control(enabled=False, reason="waiting for the app")
    if fresh.app_silent:
        return Control(enabled=False, reason="the app is silent")
    if intent in telemetry.allowed:
        return Control(enabled=True)
    if telemetry.state is State.FINISHED:
        return Control(enabled=False, reason="the session is over")
    if intent is Intent.TAKE_OVER and telemetry.steering.unavailable:
        return Control(enabled=False, reason=telemetry.steering.unavailable)
    if telemetry.state in (State.STOPPED, State.FAULT):
        return Control(enabled=False, reason="Resume first")
    return Control(enabled=False, reason=_REASONS[intent])


@dataclass(frozen=True, kw_only=True)
class AdaptationCard:
    """Progress of FCPA."""

    word: str
    tone: Tone
    fraction: float
    """Of the gradient steps, 0 to 1."""
    rows: tuple[tuple[str, str], ...]
    """Label and value."""


_STATUS: dict[str, tuple[str, Tone]] = {
    "": ("no failure yet", Tone.IDLE),
    "attribution": ("finding the chunks to blame", Tone.LEARN),
    "candidates": ("drawing better chunks", Tone.LEARN),
    "update": ("updating the policy", Tone.LEARN),
    "adapted": ("adapted", Tone.GOOD),
    "empty": ("no pairs: policy unchanged", Tone.WARN),
    "stopped": ("adapted, stopped by the guard", Tone.GOOD),
    "withdrawn": ("lesson withdrawn: a plain try next", Tone.WARN),
    "cancelled": ("cancelled", Tone.WARN),
    "failed": ("failed: policy unchanged", Tone.BAD),
    "timeout": ("over its time limit: policy unchanged", Tone.WARN),
    "none": ("this method does not adapt", Tone.IDLE),
    HIDDEN: ("not told: the plan is blinded", Tone.IDLE),
}


def adaptation(telemetry: Telemetry | None) -> AdaptationCard:
    """Step, loss, l⁺, l⁻ and pairs of the running or latest adaptation."""
    history = telemetry.adaptation if telemetry else ()
    status = telemetry.adaptation_status if telemetry else ""
    word, tone = _STATUS.get(status, (status, Tone.IDLE))
    pairs = str(telemetry.pairs) if telemetry and status not in ("", HIDDEN) else "–"
    step, loss, winner, loser = "–", "–", "–", "–"
    fraction = 0.0
    if history:
        first, last = history[0], history[-1]
        step = f"{last.step} of {last.steps}"
        loss = f"{last.loss:.4f}"
        winner = f"{last.winner_error:.4f} {_trend(first.winner_error, last.winner_error)}"
        loser = f"{last.loser_error:.4f} {_trend(first.loser_error, last.loser_error)}"
        fraction = min(1.0, last.step / max(1, last.steps))
    rows = (
        ("step", step),
        ("loss", loss),
        ("l⁺ good chunks", winner),
        ("l⁻ flagged chunks", loser),
        ("pairs", pairs),
    )
    return AdaptationCard(word=word, tone=tone, fraction=fraction, rows=rows)


def _trend(first: float, last: float) -> str:
    if first == 0:
        return ""
    change = 100 * (last - first) / abs(first)
    return f"{'▲' if change > 0 else '▼'} {abs(change):.1f} %" if abs(change) >= 0.05 else "= 0 %"


@dataclass(frozen=True, kw_only=True)
class Gauge:
    """One number of the foot line."""

    label: str
    value: str
    tone: Tone = Tone.IDLE


def loop_gauges(telemetry: Telemetry | None) -> tuple[Gauge, ...]:
    """How well the 30 Hz loop keeps time, and what the hw server had to do; what matters most comes first, since a
    narrow page shows as many as fit."""
    if telemetry is None:
        return ()
    loop, robot = telemetry.loop, telemetry.robot
    moving = telemetry.state in (State.RUNNING, State.TAKEN_OVER)
    slow = moving and loop.hz > 0 and abs(loop.hz - telemetry.rate) > 0.05 * telemetry.rate
    gauges = [
        Gauge(label="loop", value=f"{loop.hz:.1f} Hz" if loop.hz else "– Hz", tone=Tone.WARN if slow else Tone.IDLE),
        Gauge(label="late p50", value=f"{loop.late_p50_ms:.1f} ms"),
        Gauge(label="p99", value=f"{loop.late_p99_ms:.1f} ms", tone=Tone.WARN if loop.late_p99_ms > 5 else Tone.IDLE),
        Gauge(label="overruns", value=str(loop.overruns), tone=Tone.BAD if loop.overruns else Tone.IDLE),
        Gauge(label="starved", value=str(loop.starved), tone=Tone.WARN if loop.starved else Tone.IDLE),
    ]
    if telemetry.engine:
        refused = ", ".join(r.split(":")[0] for r in telemetry.engine_refused)
        word, tone = (f" ({refused} refused)", Tone.WARN) if refused else ("", Tone.IDLE)
        gauges.append(Gauge(label="engine", value=telemetry.engine + word, tone=tone))
    if robot is not None:
        gauges.append(Gauge(label="holds", value=str(robot.holds), tone=Tone.WARN if robot.holds else Tone.IDLE))
        gauges.append(Gauge(label="clips", value=str(robot.clips)))
    return (
        *gauges,
        Gauge(label="late ticks", value=_of(loop.late_ticks, loop.ticks)),
        Gauge(label="max", value=f"{loop.late_max_ms:.1f} ms"),
        Gauge(label="plan age", value=f"{loop.plan_age_ticks:.1f} ticks"),
    )


OLD_PICTURE = 0.25
"""Seconds of a camera's newest picture from which its age is told; the arm is held by then."""


def camera_note(health: CameraHealth | None) -> tuple[str, Tone]:
    """What is wrong with a camera's pictures, now and so far; empty while all were well, and for drawn ones."""
    if health is None:
        return "", Tone.IDLE
    reopened = f"back {health.reopened}×" if health.reopened else ""
    counts = [f"{n} {word}" for word in ("dropped", "stale", "frozen") if (n := getattr(health, word))]
    so_far = " · ".join(counts + [reopened] * bool(reopened))
    if health.age > OLD_PICTURE:
        return f"picture {health.age:.1f} s old" + (f" · {so_far}" if so_far else ""), Tone.WARN
    return so_far, Tone.IDLE


def arm_word(status: RobotStatus | None, person: bool = False) -> tuple[str, Tone]:
    """The arm's mode as the hw server itself reports it; `person`: who leads it is no policy."""
    if status is None:
        return "arm unknown", Tone.WARN
    tone = {
        RobotMode.HOLD: Tone.IDLE,
        RobotMode.TRACKING: Tone.RUN,
        RobotMode.HOMING: Tone.RUN,
        RobotMode.GUIDED: Tone.LEARN,
        RobotMode.LATCHED: Tone.BAD,
    }[status.mode]
    words = {
        RobotMode.HOLD: "arm holds",
        RobotMode.TRACKING: "arm follows a person" if person else "arm follows the policy",
        RobotMode.HOMING: f"arm goes home, {100 * status.homing_progress:.0f} %",
        RobotMode.GUIDED: "arm is led by hand",
        RobotMode.LATCHED: "arm latched",
    }[status.mode]
    return words, tone


def summary(history: tuple[TrialRow, ...]) -> str:
    """The session so far in one line."""
    if not history:
        return "no trial finished yet"
    history = tuple(row for row in history if row.counted)
    solved = [row for row in history if row.success]
    first = sum(row.attempts == 1 for row in solved)
    return f"{len(solved)} of {len(history)} solved · {first} at once · {len(solved) - first} after a retry"


def _of(part: int, whole: int) -> str:
    return f"{part} of {whole}" if whole else str(part)


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
