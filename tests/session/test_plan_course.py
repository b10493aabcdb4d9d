"""A plan in the real session: the right method on the right scene, told by letters, recorded in truth; what did not
count comes again; after a stop nothing goes on by itself; a real scene is held against its start image."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from far_app.lineage import VersionWish, Wish
from far_app.marks import Mark, MarkAttempt, Verdict
from far_app.protocols import Reset
from far_app.recording.reader import read_session
from far_app.recording.schema import SessionInfo
from far_app.recording.writer import SessionWriter
from far_app.session_states import Intent, State
from far_app.trial_plan.course import Equipped, PlanCourse
from far_app.trial_plan.order import letters, slots
from far_app.trial_plan.plan import Scene, TrialPlan, seeded
from far_app.trial_plan.progress import done_in, sessions_of
from far_app.trial_plan.scene_gate import References
from far_app.types import Observation
from tests.session.kinematic import Faster, Forward, KinematicRobot
from tests.session.test_session import Desk
from tests.trial_plan.plans import plan

FAST, SLOW = 0.5, 0.02


class Sitting(Desk):
    """One session of a plan whose `ours` always succeeds and whose `theirs` never does."""

    def __init__(self, root: Path, ab: TrialPlan, **settings) -> None:
        earlier = sessions_of(ab, root)
        info = SessionInfo(task="lift", method=ab.name, config={"plan": ab.record()})
        self.writer = SessionWriter(root, info, space_to_start=0, space_to_go_on=0)
        self.ours, self.theirs = Faster(Forward(FAST)), Faster(Forward(SLOW))
        self.told = []
        self.course = PlanCourse(
            ab,
            {"ours": Equipped(method=self.ours, max_attempts=2, policy="o"),
             "theirs": Equipped(method=self.theirs, max_attempts=1, policy="t")},
            earlier=earlier, folder=self.writer.folder, references=References(ab, earlier), tell=self.told.append,
        )  # fmt: skip
        super().__init__(writer=self.writer, method=self.ours, course=self.course, **settings)

    def started(self) -> list[dict]:
        log = read_session(self.writer.folder).log
        return [dict(e.detail) for e in log if e.event == "trial_started"]


def eventually(condition, what: str) -> None:
    deadline = time.monotonic() + 15
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.002)


def test_every_trial_runs_its_method_on_its_scene_in_the_plans_order_and_is_recorded_in_truth(tmp_path: Path):
    ab = plan(scenes=seeded((7, 8)), repetitions=2)
    desk = Sitting(tmp_path, ab)
    results = desk.session.run()
    order = slots(ab)
    assert [r.success for r in results] == [slot.method == "ours" for slot in order]
    assert [r.seed for r in desk.robot.requests if isinstance(r, Reset)] == [int(s.scene[5:]) for s in order]
    assert [(d["method"], d["scene"], d["repetition"]) for d in desk.started()] == [
        (s.method, s.scene, s.repetition) for s in order
    ]
    headers = [a.header for a in read_session(desk.writer.folder).attempts()]
    assert [h.method for h in headers if h] == [s.method for s in order]
    assert (desk.told[-1].done, desk.told[-1].total) == (8, 8)
    assert set(done_in(sessions_of(ab, tmp_path))) == set(order), "the disk knows it all"


def test_repetitions_of_a_scene_are_drawn_anew_and_both_methods_draw_alike(tmp_path: Path):
    ab = plan(scenes=seeded((7,)), repetitions=2)
    desk = Sitting(tmp_path, ab, horizon=3)
    noises = {}
    for name, method in (("ours", desk.ours), ("theirs", desk.theirs)):
        begin = method.begin
        method.begin = lambda seed, name=name, begin=begin: (noises.setdefault(name, []).append(seed), begin(seed))
    desk.session.run()
    assert set(noises["ours"]) == set(noises["theirs"]) and len(set(noises["ours"])) == 2


def test_a_trial_that_was_skipped_comes_again_at_the_end(tmp_path: Path):
    ab = plan(scenes=seeded((7, 8)))
    desk = Sitting(tmp_path, ab, headless=False, horizon=60)
    desk.when(desk.moving, lambda: desk.inbox.put(Intent.SKIP_TRIAL))
    desk.session.run()
    ran = [(d["method"], d["scene"]) for d in desk.started()]
    first = (slots(ab)[0].method, slots(ab)[0].scene)
    assert len(ran) == 5 and ran[0] == ran[-1] == first and desk.told[-1].done == 4


def test_a_trial_that_a_person_is_unsure_of_comes_again(tmp_path: Path):
    ab = plan(scenes=seeded((7, 8)))
    desk = Sitting(tmp_path, ab, headless=False, horizon=60)

    def unsure() -> None:
        mark = Mark(trial=1, attempt=1, verdict=Verdict.UNSURE, by="me")
        desk.inbox.say(MarkAttempt(session="test", mark=mark))

    desk.when(lambda: len(desk.session.results) == 2 and desk.moving(), unsure)
    desk.session.run()
    ran = [(d["method"], d["scene"]) for d in desk.started()]
    assert len(ran) == 5 and ran[-1] == ran[0] and desk.told[-1].done == 4


def test_in_a_plan_nobody_chooses_the_policys_versions(tmp_path: Path):
    desk = Sitting(tmp_path, plan(scenes=seeded((7,))))
    assert "in a plan every trial begins with its method's own policy" in desk.session.versions.told().unavailable
    assert desk.session.versions.refusal(VersionWish(wish=Wish.KEEP, version="base"))


def test_a_plan_goes_on_in_another_session_with_what_is_left(tmp_path: Path):
    ab = plan(scenes=seeded((7, 8)))
    first = Sitting(tmp_path, ab, headless=False, horizon=60)
    first.when(lambda: len(first.session.results) == 2 and first.moving(), lambda: first.inbox.put(Intent.QUIT))
    first.session.run()
    second = Sitting(tmp_path, ab)
    second.session.run()
    done = [(d["method"], d["scene"]) for d in first.started()[:2] + second.started()]
    assert done == [(s.method, s.scene) for s in slots(ab)] and second.told[-1].done == 4


def test_after_a_safety_stop_the_plan_stands_until_the_operator_resumes(tmp_path: Path):
    ab = plan(scenes=seeded((7, 8)))
    desk = Sitting(tmp_path, ab, headless=False, horizon=60)
    thread = threading.Thread(target=desk.session.run)
    thread.start()
    eventually(lambda: len(desk.session.results) == 1 and desk.moving(), "the second trial moves")
    desk.robot.latch("STOP pressed at the arm")
    eventually(lambda: desk.state is State.STOPPED, "it stops")
    sent, begun = len(desk.robot.targets), len(desk.started())
    time.sleep(0.5)
    assert desk.state is State.STOPPED and len(desk.robot.targets) == sent and len(desk.started()) == begun
    desk.inbox.put(Intent.RESUME)
    eventually(lambda: len(desk.robot.targets) > sent, "the operator leads on")
    thread.join(20)
    assert desk.state is State.FINISHED


def test_a_blinded_plan_gives_nothing_away_on_the_page_until_the_end(tmp_path: Path):
    ab = plan(scenes=seeded((7,)), blind=True)
    desk = Sitting(tmp_path, ab)
    shown = []
    desk.session.standing.show = lambda: shown.append(desk.session.board.telemetry(desk.state, None))
    desk.session.run()
    before = [t for t in shown if t.plan is not None and t.plan.done < 2]
    assert {t.method for t in before} == {"A", "B"}
    words = " ".join(f"{t.method} {t.policy_version} {t.log} {t.plan} {t.history} {t.reason}" for t in before)
    assert not any(word in words for word in ("ours", "theirs", "faster", "forward", "adapted"))
    assert not any(t.flagged or t.adaptation or t.pairs or len(t.value_changes) for t in before)
    assert dict(shown[-1].plan.revealed) == {letter: name for name, letter in letters(ab).items()}
    assert {d["method"] for d in desk.started()} == {"ours", "theirs"}, "the recording keeps the truth"


class Seeing(KinematicRobot):
    """With a camera whose picture the test sets."""

    picture = np.full((84, 84, 3), 90, np.uint8)

    def observe(self) -> Observation:
        return replace(super().observe(), images={"front": self.picture})


def with_cube(x: int) -> np.ndarray:
    picture = np.full((84, 84, 3), 90, np.uint8)
    picture[:30] = 160
    picture[50:58, x : x + 8] = (200, 30, 30)
    return picture


def test_a_real_scene_is_held_against_its_first_start_and_the_match_is_kept(tmp_path: Path):
    ab = plan(robot="xarm", scenes=(Scene(name="left", seed=0),))
    robot = Seeing()
    robot.picture = with_cube(20)
    desk = Sitting(tmp_path, ab, robot=robot, headless=False, await_scene=True, horizon=5)
    thread = threading.Thread(target=desk.session.run)
    thread.start()
    board = desk.session.board
    try:
        eventually(lambda: board.scene is not None and not board.scene.reference, "the first has nothing to match")
        desk.inbox.put(Intent.SCENE_READY)
        eventually(lambda: len(desk.session.results) == 1 and board.scene is not None, "the second waits")
        robot.picture = with_cube(40)
        eventually(lambda: board.scene.score is not None and board.scene.score < 0.6, "the page sees that it differs")
        desk.inbox.put(Intent.SCENE_READY)
        eventually(lambda: "press Scene ready once more" in board.refusal, "asked twice")
        assert desk.state is State.AWAITING_SCENE and len(desk.started()) == 1
        robot.picture = with_cube(21)
        eventually(lambda: board.scene.score is not None and board.scene.score > 0.9, "one pixel is near enough")
        desk.inbox.put(Intent.SCENE_READY)
        thread.join(20)
    finally:
        desk.inbox.put(Intent.QUIT)
        thread.join(20)
    first, second = [e for e in read_session(desk.writer.folder).log if e.event == "scene_matched"]
    assert first.detail["scores"] == {} and second.detail["scores"]["front"] > 0.9
    assert (desk.writer.folder / second.detail["pictures"]["front"]).stat().st_size > 100
    kept = References(ab, [read_session(desk.writer.folder)]).of("left")["front"]
    np.testing.assert_array_equal(kept, with_cube(20), "a later session is held against the same start")


def test_a_scene_that_does_not_match_may_be_taken_as_it_is_by_saying_so_twice(tmp_path: Path):
    ab = plan(robot="xarm", scenes=(Scene(name="left", seed=0),))
    robot = Seeing()
    desk = Sitting(tmp_path, ab, robot=robot, headless=False, await_scene=True, horizon=5)
    desk.course._references.keep("left", {"front": with_cube(20)})
    robot.picture = with_cube(60)
    thread = threading.Thread(target=desk.session.run)
    thread.start()
    eventually(lambda: desk.session.board.scene is not None, "it waits")
    desk.inbox.put(Intent.SCENE_READY)
    eventually(lambda: desk.session.board.refusal != "", "asked twice")
    desk.inbox.put(Intent.SCENE_READY)
    eventually(lambda: len(desk.session.results) == 1, "taken")
    desk.inbox.put(Intent.QUIT)
    thread.join(20)
    (kept,) = [e.detail for e in read_session(desk.writer.folder).log if e.event == "scene_matched"]
    assert kept["scores"]["front"] < kept["limit"] == pytest.approx(0.8)
