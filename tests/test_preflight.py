"""The preflight says in words what differs between a policy's data and the rig that is about to move."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from far_app.cli.preflight import preflight
from far_app.errors import ConfigError
from far_app.picture import Framing
from far_app.preflight import SeenView, Setup, colours_of, differences, look, setup_from
from far_app.protocols import PolicySpec
from far_app.tasks import task
from far_app.types import Observation, Pose, RobotMode, RobotStatus
from hw.camera_config import CameraConfig, with_views
from hw.rig import load_rig
from hw.setup import setup_of

ZED = SeenView(framing=Framing(eye="left", crop=(280, 0, 720, 720)), width=2560, height=720)
HERE = Setup(
    robot="xarm", arm="xarm7", rate=30.0, translation=0.008, rotation=0.05, image_size=84, views={"front": ZED}
)
CHANGES: dict[str, tuple[dict[str, Any], str]] = {
    "robot": ({"robot": "twin"}, "learnt from the twin, this is the real arm (xarm)"),
    "arm": ({"arm": "panda"}, "learnt on a panda, this is a xarm7"),
    "rate": ({"rate": 20.0}, "learnt at 20 ticks a second, the task runs at 30"),
    "translation": ({"translation": 0.005}, "moved the hand by 5 mm, here by 8 mm (scale.translation)"),
    "rotation": ({"rotation": 0.1}, "turned the hand by 0.1 rad, here by 0.05 rad"),
    "size": ({"image_size": 96}, "96×96 pixels, the rig's 84×84 (policy_image)"),
    "crop": (
        {"views": {"front": replace(ZED, framing=Framing(eye="left"))}},
        "camera 'front' was frames of 2560×720, left eye, largest centred square; here it is frames of 2560×720, left "
        "eye, crop 720×720 at (280, 0)",
    ),
    "eye": ({"views": {"front": replace(ZED, framing=replace(ZED.framing, eye="right"))}}, "was frames of 2560×720, r"),
    "frames": ({"views": {"front": replace(ZED, width=1344, height=376)}}, "was frames of 1344×376"),
    "drawn": ({"views": {"front": SeenView()}}, "camera 'front' was drawn by the twin; here it is frames of"),
}


def observation(**images: np.ndarray) -> Observation:
    return Observation(
        seq=1, stamp=1.0, eef=Pose(position=np.zeros(3), quaternion=np.array([0.0, 1.0, 0.0, 0.0])), gripper=1.0,
        joints=np.zeros(7), status=RobotStatus(mode=RobotMode.HOLD), images=images,
    )  # fmt: skip


def noise(seed: int, level: int = 100) -> np.ndarray:
    return np.random.default_rng(seed).integers(level - 50, level + 50, (84, 84, 3), np.uint8)


def test_the_same_setup_has_no_differences_also_through_json():
    again = setup_from(json.loads(json.dumps(HERE.table())))
    assert again == HERE and again is not None
    assert differences(again, HERE, ("front",)) == []


@pytest.mark.parametrize("what", CHANGES)
def test_each_difference_is_named_with_both_values(what):
    changes, words = CHANGES[what]
    (found,) = differences(replace(HERE, **changes), HERE, ("front",))
    assert words in found


def test_a_missing_view_is_named_with_those_that_are_there():
    (found,) = differences(replace(HERE, views={"front": ZED, "wrist": ZED}), HERE, ("front", "wrist"))
    assert found == "the policy looks through 'wrist', the rig has front"


def test_pictures_do_not_matter_to_a_policy_without_cameras():
    assert differences(replace(HERE, views={}, image_size=1), HERE, ()) == []


@pytest.mark.parametrize("table", [None, {}, {"views": {}}, {"views": {"front": {}}}, "old"])
def test_a_card_of_another_time_is_unknown(table):
    assert setup_from(table) is None


def test_live_pictures_are_looked_at():
    assert look(observation(front=noise(0), wrist=noise(1)), ("front", "wrist")) == []
    (dark,) = look(observation(front=np.zeros((84, 84, 3), np.uint8)), ("front",))
    assert "'front' shows nothing" in dark
    (twice,) = look(observation(front=noise(0), wrist=noise(0)), ("front", "wrist"))
    assert "'front' and 'wrist' show the same" in twice


def test_a_picture_of_other_colours_than_the_datasets_is_named():
    known = {"front": colours_of(np.stack([noise(i) for i in range(5)]))}
    assert look(observation(front=noise(9, 110)), ("front",), known) == []
    (found,) = look(observation(front=noise(9, 150)), ("front",), known)
    assert "looks different from the policy's data: mean red, green, blue" in found


def test_a_rig_tells_its_setup():
    rig = load_rig("twin")
    assert setup_of(rig, task("lift")) == Setup(
        robot="twin", arm="xarm7", rate=30.0, translation=0.008, rotation=0.05, image_size=84,
        views={"front": SeenView(), "wrist": SeenView()},
    )  # fmt: skip
    cameras = {"front": CameraConfig(device="x", width=2560, height=720, eye="left", crop=(280, 0, 720, 720))}
    rig = replace(rig, cameras=cameras)
    assert setup_of(rig, with_views(task("lift"), cameras)).views == {"front": ZED}


# ── what `far run` makes of it ──


SPEC = PolicySpec(
    name="paper-lift", task="lift", horizon=8, n_obs=2, action_dim=7, cameras=("front",), image_size=84, state_keys=()
)


def test_differences_refuse_the_start_all_in_one_line_and_may_be_accepted(caplog):
    other = {"setup": replace(HERE, rate=20.0, translation=0.005).table()}
    with pytest.raises(ConfigError) as refused:
        preflight(SPEC, other, HERE, observation(front=noise(0)), accepted=False)
    words = str(refused.value)
    assert "(1) " in words and "(2) " in words and "--accept-differences" in words and "\n" not in words
    preflight(SPEC, other, HERE, observation(front=noise(0)), accepted=True)
    assert "goes on" in caplog.text


def test_an_old_card_refuses_a_real_arm_and_warns_in_the_twin(caplog):
    with pytest.raises(ConfigError, match="cannot compare"):
        preflight(SPEC, {}, HERE, observation(front=noise(0)), accepted=False)
    preflight(SPEC, {}, replace(HERE, robot="twin"), observation(front=noise(0)), accepted=False)
    assert "cannot compare" in caplog.text


def test_a_policy_that_no_data_made_has_nothing_to_compare():
    preflight(SPEC, None, HERE, observation(), accepted=False)


def test_the_shipped_model_knows_the_twin():
    from far_app.cli.assemble import shipped
    from far_app.learning.policy import read_card

    rig = load_rig("twin")
    trained = setup_from(read_card(shipped("lift", "policy"))["setup"])
    assert trained == setup_of(rig, task("lift"))
