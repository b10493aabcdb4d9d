"""A plan as a session runs it: the trials that are not done, in the plan's order; one that did not count comes again at
the end. What is done is what the recordings say, this session's own included.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from far_app.errors import RecordingError
from far_app.protocols import Method
from far_app.recording.reader import SessionRecording, read_session
from far_app.session.course import Assignment
from far_app.session.settings import TrialResult
from far_app.session_report.outcomes import TrialOutcome
from far_app.trial_plan.order import Slot, slots
from far_app.trial_plan.plan import TrialPlan, chance
from far_app.trial_plan.progress import done_in
from far_app.trial_plan.scene_gate import References, SceneGate
from far_app.trial_plan.shown import PlanShown
from far_app.trial_plan.telling import Teller


@dataclass(frozen=True, kw_only=True)
class Equipped:
    """A planned method, ready to act."""

    method: Method
    max_attempts: int
    policy: str
    """Checkpoint, for the recording."""


class PlanCourse:
    """far_app.session.course.Course."""

    fixed = "in a plan every trial begins with its method's own policy"

    def __init__(
        self,
        plan: TrialPlan,
        equipped: Mapping[str, Equipped],
        *,
        earlier: Sequence[SessionRecording],
        folder: Path,
        references: References,
        tell: Callable[[PlanShown], None],
    ) -> None:
        """`earlier`: the plan's sessions before this one, which records to `folder`. `tell` hears after every trial."""
        self.plan, self._equipped, self._references, self._tell = plan, equipped, references, tell
        self._earlier, self._folder = done_in(earlier), folder
        self._newest: dict[Slot, TrialOutcome] = {}
        """The trial that has just ended, until the disk has it."""
        self._ended = 0
        """Trials of this session."""
        self._teller = Teller(plan=plan, attempts={name: e.max_attempts for name, e in equipped.items()})
        self._scenes = {scene.name: scene for scene in plan.scenes}
        self._now: Slot | None = None
        self._queue = deque(slot for slot in slots(plan) if slot not in self._earlier)

    def next(self) -> Assignment | None:
        done = self._done()
        taken_back = (slot for slot in slots(self.plan) if slot not in done and slot not in self._queue)
        self._queue.extend(taken_back)  # marked unsure since
        self._now = self._queue.popleft() if self._queue else None
        if self._now is None:
            return None
        slot, scene, arm = self._now, self._scenes[self._now.scene], self._equipped[self._now.method]
        label = self._teller.label(slot.method, blinded=self.plan.blind)
        real = self.plan.robot != "twin"
        return Assignment(
            seed=scene.seed, method=arm.method, label=label, chance=chance(scene, slot.repetition),
            max_attempts=arm.max_attempts, blind=self.plan.blind,
            gate=SceneGate(scene.name, self._references, self.plan.match) if real else None,
            record={
                "method": slot.method, "label": label, "scene": slot.scene, "repetition": slot.repetition,
                "max_attempts": arm.max_attempts, "policy": arm.policy,
            },
        )  # fmt: skip

    def ended(self, assignment: Assignment, result: TrialResult) -> None:
        slot = self._now
        assert slot is not None, "a trial that ended was given out by next()"
        self._now, self._newest = None, {}
        self._ended += 1
        if result.finished and result.counted:
            self._newest[slot] = TrialOutcome(
                session=self._folder.name, trial=self._ended, scene=result.seed, attempts=result.attempts,
                solved_by=result.attempts if result.success else None, repetition=slot.repetition,
            )  # fmt: skip
        else:
            self._queue.append(slot)
        self._tell(self.shown())

    def shown(self) -> PlanShown:
        return self._teller.shown(self._done(), self._now)

    def _done(self) -> dict[Slot, TrialOutcome]:
        """The disk's word as soon as it has one: it has the marks that were made since."""
        try:
            session = read_session(self._folder)
        except RecordingError:
            return {**self._newest, **self._earlier}
        written = sum(entry.event == "trial_ended" for entry in session.log)
        newest = self._newest if written < self._ended else {}
        return {**newest, **done_in([session]), **self._earlier}
