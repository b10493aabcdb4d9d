"""The policy versions of a running session: undo an adaptation, restore any version, keep one as the base of trials.

A wish takes effect where nothing moves: the next attempt's start (undo, restore) or the next trial's (keep). Weights
are kept in memory up to LIMIT bytes, older ones are read from the recording.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from far_app.errors import FarError
from far_app.lineage import BASE, PolicyRow, Versions, VersionWish, Wish
from far_app.protocols import ChangesWeights, Method
from far_app.recording.session_folder import attempt_name
from far_app.recording.weights_file import read_weights, weights_path
from far_app.session.standing import IN_ATTEMPT, Standing
from far_app.session_states import State
from far_app.types import Adaptation, AdaptedWeights

log = logging.getLogger(__name__)

LIMIT = 512 * 2**20
ROWS = 100


class VersionKeeper:
    def __init__(self, standing: Standing, method: Method, folder: Path | None, fixed: str = "") -> None:
        """`folder`: the session's recording, where old weights lie. `fixed`: why the operator chooses no versions
        here."""
        self.standing, self._folder, self._fixed = standing, folder, fixed
        self._method = method if isinstance(method, ChangesWeights) and not fixed else None
        self._rows: dict[str, PolicyRow] = {BASE: PolicyRow(name=BASE, parent="")}
        self._weights: dict[str, AdaptedWeights] = {}
        self._next: VersionWish | None = None
        self._new_base = ""
        self._base = self.acting = BASE
        self._learnt = ""
        """The version that the newest adaptation of this trial made; "" when it made none."""

    # ── what happens ──

    def trial_begins(self) -> None:
        """The base acts again, or what was chosen to be it."""
        if self._next is not None and self._next.wish is Wish.UNDO:
            self._next = None
        if self._new_base and self._method is not None and self._use(self._new_base, base=True):
            self._base, self._new_base = self._new_base, ""
        self.acting, self._learnt = self._base, ""

    def attempt_begins(self, version: str) -> str:
        """Take what was wished for; returns the version that acts, as its policy calls it."""
        wished, self._next = self._next, None
        if self._learnt:
            self.acting, self._learnt = self._learnt, ""
        if wished is not None and self._method is not None and self._use(wished.version, base=False):
            self.acting = wished.version
            return self._method.policy.version
        return version

    def adapted(self, adaptation: Adaptation, weights: AdaptedWeights | None) -> None:
        """An adaptation is over; `weights` when it made a version."""
        if adaptation.status == "withdrawn":
            self.acting = self._base
        if weights is None or self._fixed:
            return
        board = self.standing.board
        name = f"{board.trial}:{weights.version}"
        parent = weights.parent if weights.parent in self._rows else f"{board.trial}:{weights.parent}"
        self._rows[name] = PolicyRow(
            name=name, parent=parent, trial=board.trial, attempt=board.attempt, pairs=adaptation.pairs
        )
        self._weights[name], self._learnt = weights, name
        while len(self._weights) > 1 and self._size() > LIMIT:
            self._weights.pop(next(iter(self._weights)))
        while len(self._rows) > ROWS + 1:
            oldest = next(name for name in self._rows if name not in (BASE, self._base, self.acting))
            self._rows.pop(oldest)
            self._weights.pop(oldest, None)

    def attempt_ended(self, success: bool) -> None:
        row = self._rows.get(self.acting)
        if row is not None:
            self._rows[self.acting] = replace(row, acted=row.acted + 1, solved=row.solved + success)

    # ── what the operator asks ──

    def hear(self, asked: VersionWish) -> None:
        """Refuse with a reason, or note it for the next start."""
        why, standing = self.refusal(asked), self.standing
        if why:
            standing.board.refusal = why
            return standing.say(why, "warning")
        if asked.wish is Wish.KEEP:
            self._new_base = asked.version
            words = f"from the next trial on, trials begin with {asked.version}"
        else:
            target = self.undo_target() if asked.wish is Wish.UNDO else asked.version
            self._next = replace(asked, version=target)
            words = f"from the next attempt on {target} acts"
        what = {Wish.UNDO: "undone", Wish.RESTORE: "restored", Wish.KEEP: "kept"}[asked.wish]
        version = self._new_base if asked.wish is Wish.KEEP else self._next.version if self._next else ""
        standing.recorder.event(f"policy_{what}", words, {"version": version, "by": asked.by})
        return standing.say(f"{words} ({asked.by or 'the operator'})")

    def refusal(self, asked: VersionWish) -> str:
        """Why a wish is refused; "" when it is taken."""
        if why := self.unavailable():
            return f"'{asked.wish}' is refused: {why}"
        if self.standing.state is State.FINISHED:
            return f"'{asked.wish}' is refused: the session is over; use far policy promote"
        if asked.wish is Wish.UNDO:
            return "" if self.undo_target() else "'undo' is refused: this trial's next attempt undoes nothing"
        if asked.version not in self._rows:
            return f"'{asked.wish}' is refused: this session knows no version '{asked.version}'"
        if asked.wish is Wish.KEEP and asked.version == (self._new_base or self._base):
            return f"'keep' is refused: trials begin with {asked.version} already"
        return ""

    def unavailable(self) -> str:
        return self._fixed or ("" if self._method is not None else "this method has no weights that change")

    def undo_target(self) -> str:
        """What an undo would lead to; "" when there is nothing to undo in this trial."""
        state, board = self.standing.state, self.standing.board
        if state is State.ADAPTING or (state is State.PAUSED and (board.adapting or self._learnt)):
            return self.acting if board.adapting or self._learnt else ""
        if state in (*IN_ATTEMPT, State.PAUSED) and self.acting != self._base:
            row = self._rows.get(self.acting)
            return row.parent if row is not None and row.parent in self._rows else ""
        return ""

    def told(self) -> Versions:
        """For the page."""
        return Versions(
            rows=tuple(self._rows.values()), acting=self._learnt or self.acting, base=self._new_base or self._base,
            next=self._next.version if self._next is not None else "", undo=self.undo_target(),
            unavailable=self.unavailable(),
        )  # fmt: skip

    # ── within ──

    def _use(self, name: str, *, base: bool) -> bool:
        """False, with a word on the page, where the weights cannot be had."""
        assert self._method is not None
        try:
            self._method.use(None if name == BASE else self._found(name), name, base=base)
        except FarError as error:
            self.standing.say(f"{name} could not be taken: {error}", "error")
            return False
        return True

    def _found(self, name: str) -> AdaptedWeights:
        if name in self._weights:
            return self._weights[name]
        row = self._rows[name]
        if self._folder is None:
            raise FarError(f"the weights of {name} are no longer in memory, and there is no recording")
        return read_weights(weights_path(self._folder / attempt_name(row.trial, row.attempt)))

    def _size(self) -> int:
        return sum(t.nbytes for weights in self._weights.values() for t in weights.tensors.values())
