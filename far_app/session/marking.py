"""The operator's words on attempts while a session runs: kept, shown beside the program's own judgment, and counted."""

from __future__ import annotations

from far_app.marks import MarkAttempt, Verdict, trouble
from far_app.recording import marks
from far_app.session.standing import IN_ATTEMPT, Standing
from far_app.session_states import State


class Marking:
    def __init__(self, standing: Standing, session: str) -> None:
        self.standing, self._session = standing, session

    def hear(self, asked: MarkAttempt) -> None:
        """Keep a word, or say why not."""
        mark, standing = asked.mark, self.standing
        why = self.refusal(asked)
        if why:
            standing.board.refusal = why
            return standing.say(f"a mark was not kept: {why}", "warning")
        standing.recorder.event(marks.EVENT, mark.note, marks.detail(mark))
        standing.board.history.marked(mark)
        what = mark.verdict or "note"
        return standing.say(f"trial {mark.trial}, attempt {mark.attempt}: {what} by {mark.by} {mark.note}".rstrip())

    def refusal(self, asked: MarkAttempt) -> str:
        """Why a mark is not kept; "" when it is."""
        mark, board = asked.mark, self.standing.board
        if asked.session != self._session:
            return f"it is for session '{asked.session}', this is '{self._session}'; use far mark"
        if why := trouble(mark):
            return why
        if board.history.has(mark.trial, mark.attempt):
            return ""
        running = self.standing.state in (*IN_ATTEMPT, State.PAUSED)
        if not running or (mark.trial, mark.attempt) != (board.trial, board.attempt):
            return f"trial {mark.trial}, attempt {mark.attempt} has not been made"
        if mark.verdict in (Verdict.SUCCESS, Verdict.FAILURE):
            return "the attempt is under way: Mark success or Mark failure ends it"
        return ""
