"""What the operator page is told: the session's side of far_app/telemetry.py, gathered by the loop, read whole."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import replace

import numpy as np

from far_app.config import TaskConfig
from far_app.lineage import Versions
from far_app.motion import ActionScale
from far_app.protocols import EngineReport
from far_app.session.history import History
from far_app.session_states import Intent, State
from far_app.take_over import Steering
from far_app.telemetry import HIDDEN, LogLine, Telemetry, TrialRow
from far_app.trial_plan.shown import PlanShown, SceneShown
from far_app.types import ActionChunk, Adaptation, AdaptationStep, Observation, Step, Trial


class Board:
    """Filled and read by the loop's thread only; `telemetry` is handed to the publisher."""

    def __init__(
        self, task: TaskConfig, scale: ActionScale, *, session: str, method: str, trials: int, chunk_horizon: int
    ) -> None:
        self._task, self._scale = task, scale
        self._session, self._method, self._trials = session, method, trials
        self._chunk_horizon = chunk_horizon
        self.history = History()
        self._log = deque[LogLine](maxlen=50)
        self._log_told: tuple[LogLine, ...] = ()
        """The same, made anew after a change only."""
        self._values: list[float] = []
        self._helped = 0
        """Ticks of the attempt in which a person had the arm: the horizon stands still meanwhile."""
        self._step: Step | None = None
        self._chunk: ActionChunk | None = None
        self._curve: Adaptation | None = None
        """The failed attempt's values and flags, while they are on show."""
        self._latest: Adaptation | None = None
        """The running or latest adaptation of the trial."""
        self._began = time.monotonic()
        self.reason = ""
        self.countdown = 0.0
        """Seconds until an announced attempt begins."""
        self.refusal = ""
        self.steering = Steering()
        self.versions = Versions()
        self.adaptation_steps: tuple[AdaptationStep, ...] = ()
        self.adapting = False
        self.trial = self.attempt = self.scene_seed = 0
        self.policy_version = ""
        self.plan: PlanShown | None = None
        self.scene: SceneShown | None = None
        """A real scene of a plan that is being rebuilt."""
        self.blind = False
        """Nothing that gives the method away is shown."""
        self._max_attempts = task.max_attempts
        self.engine = EngineReport(name="")
        """What runs the policy of the attempt."""
        self.plan: PlanShown | None = None
        self.scene: SceneShown | None = None
        """A real scene of a plan that is being rebuilt."""
        self.blind = False
        """Nothing that gives the method away is shown."""
        self._max_attempts = task.max_attempts

    def log(self, text: str, level: str = "info") -> None:
        self._log.append(LogLine(stamp=time.monotonic(), level=level, text=text))
        self._log_told = tuple(self._log)

    def trial_awaited(self, method: str, *, blind: bool) -> None:
        """What is told of the trial that comes."""
        self._method, self.blind = method, blind
        self.attempt, self.policy_version = 0, ""
        self._clear()

    def trial_started(self, trial: int, scene_seed: int, max_attempts: int) -> None:
        self._max_attempts = max_attempts
        self.trial, self.scene_seed, self.attempt = trial, scene_seed, 1
        self._began = time.monotonic()
        self._latest, self.adaptation_steps = None, ()
        self._clear()

    def attempt_started(self, attempt: int, policy_version: str) -> None:
        self.attempt, self.policy_version = attempt, policy_version
        self._clear()

    def stepped(self, step: Step) -> None:
        """V of a tick often arrives with a later one; the curve has one entry a tick, NaN where there is none."""
        self._step = step
        self._values.append(step.value)
        self._helped += step.intervention

    def planned(self, chunk: ActionChunk) -> None:
        self._chunk = chunk
        if 0 <= chunk.tick < len(self._values):
            self._values[chunk.tick] = chunk.value

    def adaptation_started(self) -> None:
        self.adapting, self._latest, self.adaptation_steps = True, None, ()

    def attributed(self, known: Adaptation | None) -> None:
        """What a running adaptation knows so far."""
        if self.adapting and known is not None:
            self._curve = self._latest = known

    def adapted(self, adaptation: Adaptation) -> None:
        self.adapting, self._latest = False, adaptation
        self.adaptation_steps = adaptation.history or self.adaptation_steps

    def trial_ended(self, trial: Trial, judged_by: str, note: str, counted: bool = True) -> None:
        self.history.trial_ended(
            TrialRow(
                trial=self.trial, scene_seed=self.scene_seed, attempts=len(trial.attempts), success=trial.success,
                judged_by=judged_by, flagged=sum(len(a.flagged) for a in trial.adaptations),
                seconds=time.monotonic() - self._began, note=note, counted=counted,
            )
        )  # fmt: skip

    def telemetry(self, state: State, newest: Observation | None, allowed: tuple[Intent, ...] = ()) -> Telemetry:
        """A snapshot; sequence number, stamp and loop health are the publisher's."""
        curve, latest, step = self._curve, self._latest, self._step
        values = curve.values if curve is not None and len(curve.values) else self._values
        status = latest.status if latest else ""
        if self.adapting and status in ("", "none"):
            status = "update" if self.adaptation_steps else "attribution" if latest is None else "candidates"
        whole = Telemetry(
            seq=0, stamp=0.0, state=state, reason=self.reason, countdown=self.countdown, session=self._session,
            task=self._task.name, method=self._method, policy_version=self.policy_version, engine=self.engine.name,
            engine_refused=self.engine.refused, trial=self.trial, trials=self._trials, attempt=self.attempt,
            max_attempts=self._max_attempts, scene_seed=self.scene_seed,
            tick=len(self._values), horizon=self._task.horizon + self._helped,
            rate=self._task.rate, chunk_horizon=self._chunk_horizon,
            values=np.array(values, dtype=float),
            value_changes=curve.value_changes if curve else np.zeros(0),
            threshold=curve.threshold if curve else float("nan"), flagged=curve.flagged if curve else (),
            adaptation=self.adaptation_steps, adaptation_status=status,
            pairs=latest.pairs if latest else 0,
            homing_progress=newest.status.homing_progress if newest else 0.0,
            robot=newest.status if newest else None, joints=newest.joints if newest else np.zeros(0),
            eef=newest.eef if newest else None, gripper=newest.gripper if newest else 0.0,
            action=step.commanded if step is not None else np.zeros(0), chunk_path=self._path(newest),
            history=self.history.trials,
            attempts=self.history.attempts, log=self._log_told, refusal=self.refusal, allowed=allowed,
            steering=self.steering, versions=self.versions, plan=self.plan, scene=self.scene,
        )  # fmt: skip
        return blinded(whole) if self.blind else whole

    def _path(self, newest: Observation | None) -> np.ndarray:
        """Positions the newest chunk leads through from here, metres (H, 3)."""
        if self._chunk is None or newest is None:
            return np.zeros((0, 3))
        return newest.eef.position + self._scale.translation * np.cumsum(self._chunk.actions[:, :3], axis=0)

    def _clear(self) -> None:
        self._values = []
        self._helped = 0
        self._step = self._chunk = self._curve = None
        self.adapting = False


def blinded(telemetry: Telemetry) -> Telemetry:
    """Without what tells which method acts: what it learnt, from what, and which version of the policy it left."""
    history = tuple(replace(row, flagged=0) for row in telemetry.history)
    attempts = tuple(replace(attempt, policy_version="") for attempt in telemetry.attempts)
    return replace(
        telemetry, policy_version="", value_changes=np.zeros(0), threshold=float("nan"), flagged=(), adaptation=(),
        adaptation_status=HIDDEN if telemetry.adaptation_status else "", pairs=0, history=history,
        attempts=attempts, versions=Versions(unavailable=telemetry.versions.unavailable),
    )  # fmt: skip
