"""What a plan says so far comes from its recordings: which trials count, the figures, and the truth only at the end."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from far_app.errors import ConfigError
from far_app.recording.reader import read_session
from far_app.recording.schema import SessionInfo
from far_app.recording.writer import SessionWriter
from far_app.session_states import Intent
from far_app.statistics import Z95
from far_app.trial_plan.order import Slot, letters, slots
from far_app.trial_plan.plan import PlannedMethod, TrialPlan, seeded
from far_app.trial_plan.progress import done_in, sessions_of, trials_to_go
from far_app.trial_plan.telling import Teller, lines
from far_app.types import Judge, Outcome
from tests.recording import values
from tests.trial_plan.plans import plan


class Sitting:
    """A session of a plan, written trial by trial."""

    def __init__(self, root: Path, ab: TrialPlan) -> None:
        info = SessionInfo(task="lift", method=ab.name, cameras=("front",), config={"plan": ab.record()})
        self.writer = SessionWriter(root, info, space_to_start=0, space_to_go_on=0)
        self.trials = 0

    def trial(self, slot: Slot, solved_by: int | None, attempts: int = 2, *, end: bool = True) -> None:
        self.trials += 1
        detail = {
            "method": slot.method, "label": "A", "scene": slot.scene, "repetition": slot.repetition,
            "max_attempts": attempts, "policy": "p",
        }  # fmt: skip
        self.writer.begin_trial(self.trials, int(slot.scene.split()[-1]), detail)
        for k in range(1, (solved_by or attempts) + 1):
            self.writer.begin_attempt(k, "base")
            self.writer.end_attempt(values.attempt(k, 1, success=k == solved_by))
        if end:
            self.writer.end_trial(solved_by is not None, solved_by or attempts)

    def close(self) -> Path:
        self.writer.close()
        return self.writer.folder


def teller(ab: TrialPlan) -> Teller:
    return Teller(plan=ab, attempts={"ours": 2, "theirs": 2})


def test_sittings_add_up_and_a_trial_that_was_cut_short_is_run_again(tmp_path: Path):
    ab, (one, two, three, *_) = plan(), slots(plan())
    first = Sitting(tmp_path, ab)
    first.trial(one, 2)
    first.trial(two, None, end=False)  # killed
    first.close()
    second = Sitting(tmp_path, ab)
    second.trial(two, None)
    second.writer.event("intent", Intent.STOP)
    second.trial(three, 1)
    second.close()
    done = done_in(sessions_of(ab, tmp_path))
    assert {slot: t.solved_by for slot, t in done.items()} == {one: 2, two: None, three: 1}


def test_a_skipped_trial_does_not_count_though_it_used_its_last_attempt(tmp_path: Path):
    ab, slot = plan(), slots(plan())[0]
    sitting = Sitting(tmp_path, ab)
    sitting.trial(slot, None, 1, end=False)
    sitting.writer.event("intent", Intent.SKIP_TRIAL)
    sitting.writer.end_trial(success=False, attempts=1)
    sitting.close()
    assert not done_in(sessions_of(ab, tmp_path))


def test_a_mark_made_later_changes_the_figures(tmp_path: Path):
    ab, slot = plan(), slots(plan())[0]
    sitting = Sitting(tmp_path, ab)
    sitting.trial(slot, None)
    sitting.writer.mark(Outcome(success=True, judged_by=Judge.OPERATOR), trial=1, attempt=2)
    assert done_in([read_session(sitting.close())])[slot].solved_by == 2


def test_another_plan_of_the_same_name_is_refused_and_a_longer_one_goes_on(tmp_path: Path):
    ab = plan()
    Sitting(tmp_path, ab).close()
    longer = replace(ab, repetitions=3, precision=5.0, scenes=(*ab.scenes, *seeded((10,))))
    assert len(sessions_of(longer, tmp_path)) == 1
    other = replace(ab, methods=(replace(ab.methods[0], retry={"fcpa": {"lr": 1e-6}}), ab.methods[1]))
    with pytest.raises(ConfigError, match=r"name is 'ab'.*holds trials of another plan \(other: methods\)"):
        sessions_of(other, tmp_path)
    assert not sessions_of(replace(other, name="ab2"), tmp_path)


def test_the_figures_are_wilsons_and_mcnemars_over_the_scenes_both_have(tmp_path: Path):
    ab = plan()
    sitting = Sitting(tmp_path, ab)
    for scene, ours, theirs in (("seed 7", 1, None), ("seed 8", 2, None), ("seed 9", 1, 1)):
        sitting.trial(Slot(method="ours", scene=scene, repetition=1), ours)
        sitting.trial(Slot(method="theirs", scene=scene, repetition=1), theirs)
    shown = teller(ab).shown(done_in([read_session(sitting.close())]))
    assert [(a.label, a.solved) for a in shown.arms] == [("ours", (2, 3)), ("theirs", (1, 1))]
    assert shown.arms[0].low[1] == pytest.approx(0.4385, abs=1e-3) and shown.arms[0].high[1] == 1.0
    (d,) = shown.differences
    assert (d.left, d.right, d.pairs, d.only_left, d.only_right) == ("ours", "theirs", 3, 2, 0)
    assert d.mean == pytest.approx(2 / 3) and d.p == 0.5
    assert "ours − theirs: +67 points" in "\n".join(lines(shown)) and shown.done == shown.total == 6


def test_a_method_with_one_attempt_is_compared_within_its_own(tmp_path: Path):
    ab = plan(methods=(PlannedMethod(name="ours", method="far"), PlannedMethod(name="theirs", method="dp")))
    sitting = Sitting(tmp_path, ab)
    sitting.trial(Slot(method="ours", scene="seed 7", repetition=1), 2)
    sitting.trial(Slot(method="theirs", scene="seed 7", repetition=1), None, attempts=1)
    told = Teller(plan=ab, attempts={"ours": 2, "theirs": 1}).shown(done_in([read_session(sitting.close())]))
    assert told.differences[0].mean == 1.0 and told.arms[1].solved == (0,)


def test_a_blinded_plan_tells_letters_until_its_last_trial_is_done(tmp_path: Path):
    ab = plan(blind=True, scenes=seeded((7,)))
    sitting = Sitting(tmp_path, ab)
    first, last = slots(ab)
    sitting.trial(first, 1)
    before = teller(ab).shown(done_in([read_session(sitting.writer.folder)]), last)
    told = repr(before) + "\n".join(lines(before))
    assert not any(word in told for word in ("ours", "theirs", "far")) and before.label == letters(ab)[last.method]
    sitting.trial(last, None)
    after = teller(ab).shown(done_in([read_session(sitting.close())]))
    assert dict(after.revealed) == {letter: name for name, letter in letters(ab).items()}
    assert [a.label for a in after.arms] == ["ours", "theirs"]


def test_trials_to_go_reach_the_wished_width_at_the_smoothed_spread():
    for pairs, left, right in ((10, 3, 1), (40, 12, 4), (5, 0, 0)):
        to_go = trials_to_go(pairs, left, right, 10.0)
        spread = (left + right + 1) / (pairs + 2) - ((left - right) / (pairs + 2)) ** 2
        n = pairs + to_go // 2
        assert to_go % 2 == 0 and Z95 * math.sqrt(spread / n) <= 0.10 < Z95 * math.sqrt(spread / (n - 1))
    assert trials_to_go(5, 0, 0, 10.0) > 0, "agreement of a few pairs proves nothing"
    assert trials_to_go(500, 20, 20, 10.0) == 0
    assert trials_to_go(10, 3, 1, 20.0) < trials_to_go(10, 3, 1, 10.0)
