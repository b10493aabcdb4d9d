"""What a trial learns from its failed attempts: one adaptation at a time in the background, told to the page and the
recording as it goes, corrected by the operator's word on a chunk.
"""

from __future__ import annotations

from far_app.protocols import KeepsWeights, Method
from far_app.session.adaptation import BackgroundAdaptation, unchanged
from far_app.session.lockstep import FinishedAdaptation
from far_app.session.standing import Standing
from far_app.session.versions import VersionKeeper
from far_app.trial import RunningAdaptation
from far_app.types import Adaptation, Attempt
from far_app.what_if import CorrectFlag


class Lessons:
    def __init__(self, standing: Standing, versions: VersionKeeper, *, session: str, limit: float) -> None:
        self.standing, self.versions = standing, versions
        self._session = session
        """The session's name: a word on another session's chunk is not kept here."""
        self._limit = limit
        """Seconds after which a retry no longer waits for its adaptation."""
        self._running: BackgroundAdaptation | None = None
        self._reported = 0
        """Of the running adaptation's gradient steps."""
        self.learnt: list[Adaptation] = []
        """The trial's adaptations, oldest first."""

    def trial_begins(self) -> None:
        self.learnt = []

    def start(self, method: Method, attempt: Attempt) -> RunningAdaptation:
        """far_app/trial.py's StartAdaptation: in a thread, unless there is nothing to learn from."""
        if self.standing.no_lesson:
            return FinishedAdaptation(unchanged(method.policy.version, "none", attempt.outcome.note))
        self.end()
        self._reported = 0
        self.standing.board.adaptation_started()
        self._running = BackgroundAdaptation(method, attempt, self._limit)
        return self._running

    def report(self) -> None:
        """What the running adaptation came to know since the last call goes to the page and the recording."""
        if self._running is None:
            return
        board, running = self.standing.board, self._running
        board.attributed(running.known)
        steps = tuple(running.progress)
        self._reported = min(self._reported, len(steps))  # it may have begun anew
        if len(steps) > self._reported:
            for step in steps[self._reported :]:
                self.standing.recorder.add_adaptation_step(step)
            board.adaptation_steps, self._reported = steps, len(steps)

    def correct(self, asked: CorrectFlag) -> None:
        """The operator's word on a chunk: kept, and used when its attempt is the one being learnt from."""
        standing, board, running = self.standing, self.standing.board, self._running
        if asked.session != self._session:
            return standing.say(f"a correction for session '{asked.session}' is not kept here", "warning")
        here = (asked.trial, asked.attempt) == (board.trial, board.attempt)
        word = asked.correction
        used = here and board.adapting and running is not None and running.correct(word)
        detail = {
            "trial": asked.trial, "attempt": asked.attempt, "tick": word.tick, "flagged": word.flagged, "by": word.by,
            "used": used,
        }  # fmt: skip
        standing.recorder.event("flag_corrected", "", detail)
        then = "the adaptation begins anew with it" if used else "kept; too late for an adaptation"
        what = "flagged" if word.flagged else "unflagged"
        return standing.say(f"chunk {word.tick} of attempt {asked.attempt} {what} by {word.by}: {then}")

    def adapted(self, adaptation: Adaptation, method: Method) -> None:
        """An adaptation is over: keep it, and the weights it made."""
        self.report()
        self.learnt.append(adaptation)
        self.standing.board.adapted(adaptation)
        self.standing.recorder.add_adaptation(adaptation)
        weights = method.adapted if isinstance(method, KeepsWeights) else None
        new = weights is not None and weights.version == adaptation.version != adaptation.base_version
        if weights is not None and new:
            self.standing.recorder.add_weights(weights, adaptation)
        self.versions.adapted(adaptation, weights if new else None)
        if self.standing.board.blind:
            return self.standing.say("the arm is home and what follows the failure is done")
        note = f" ({adaptation.note})" if adaptation.note else ""
        return self.standing.say(
            f"adaptation: {adaptation.status}, {adaptation.pairs} pairs → {adaptation.version}{note}"
        )

    def end(self) -> None:
        """Cancel what still runs; returns once it has ended."""
        if self._running is not None:
            self._running.cancel(wait=True)
        self._running = None
        self.standing.board.adapting = False
