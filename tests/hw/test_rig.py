"""A rig's file, and what its stations change in it."""

import dataclasses
import re

import numpy as np
import pytest

from far_app.errors import ConfigError
from far_app.tasks import TASKS
from hw.rig import RIGS, STILL_BY, WATCHDOG, laid_over, load_rig
from hw.safety import violation

NAMES = sorted(p.stem for p in RIGS.glob("*.toml"))


def test_a_station_replaces_what_it_names_and_leaves_the_rest():
    table = {"a": 1, "b": 2, "safety": {"low": 0, "high": 9}}
    assert laid_over(table, {"b": 3, "safety": {"high": 5}, "c": 4}) == {
        "a": 1, "b": 3, "safety": {"low": 0, "high": 5}, "c": 4,
    }  # fmt: skip
    assert table == {"a": 1, "b": 2, "safety": {"low": 0, "high": 9}}


def test_the_twin_s_first_task_has_no_station_of_its_own():
    assert load_rig("twin", "lift") == load_rig("twin")
    other = load_rig("twin", "can")
    assert other.base and other.safety.box_max != load_rig("twin").safety.box_max
    assert other.scale == load_rig("twin").scale and other.safety.speed == load_rig("twin").safety.speed


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("task", sorted(TASKS))
def test_the_start_pose_lies_well_inside_the_box_at_every_station(name, task):
    rig = load_rig(name, task)
    for nudge in 0.02 * np.vstack([np.eye(3), -np.eye(3)]):
        assert violation(np.array(rig.start_position) + nudge, rig.safety) == 0.0


@pytest.mark.parametrize("name", NAMES)
def test_every_station_is_a_task_s(name):
    import tomllib

    stations = tomllib.loads((RIGS / f"{name}.toml").read_text()).get("station", {})
    assert set(stations) <= set(TASKS)


def test_a_station_s_unknown_setting_is_named(tmp_path):
    path = tmp_path / "odd.toml"
    path.write_text((RIGS / "twin.toml").read_text() + "\n[station.stack]\ncolour = 3\n")
    assert dataclasses.asdict(load_rig(str(path)))["name"] == "twin"
    with pytest.raises(ConfigError, match="colour"):
        load_rig(str(path), "stack")


@pytest.mark.parametrize("name", ["twin", "xarm7", "paper"])
def test_a_rig_stands_still_in_time_after_its_last_target(name):
    rig = load_rig(name)
    assert rig.watchdog <= WATCHDOG and rig.watchdog + rig.safety.braking <= STILL_BY


REFUSED = [
    ("acceleration = 8.0", "acceleration = 4.0", "162 ms after the last .limit 150 ms"),
    ("rotation_acceleration = 50.0", "rotation_acceleration = 20.0", "175 ms after the last"),
    ('robot = "xarm"', 'robot = "xarm"\nwatchdog = 0.5', "watchdog is 0.5 s, must be above 0 and at most 0.1"),
    ("step_translation = 0.012", "step_translation = inf", "step_translation is inf, must be a number above 0"),
    ("servo_step = 0.0025", "servo_turn = 0.01\nservo_step = 0.0025", "0.01 rad at 100 Hz allow 1 rad/s"),
    ("step_translation = 0.012", "step_translation = 0.5", "step_translation is 0.5, must be at most 0.05"),
    ("speed = 0.15", "speed = 0.0", "home speed is 0.0, must be above 0"),
    ("collision_sensitivity = 3", "collision_sensitivity = 0", "collision_sensitivity is 0, must be 1 to 5"),
    ("latency_limit = 0.015", "latency_limit = 2.0", "latency_limit is 2.0, must be 0.001 to 0.05"),
    ("tcp_offset = [0.0, 0.0, 0.172", "tcp_offset = [0.0, 0.0, 172.0", "must be within 0.5 m of the flange"),
    ('kind = "g1"', 'kind = "g2"', "gripper.open is 850, a g2's must be 0 to 84"),
    ("speed = 3000.0", "speed = 150.0", "gripper.speed is 150, a g1's must be 1000 to 5000"),
    ("closed = 0.0", "closed = 850.0", "open and closed are both 850"),
]  # fmt: skip


@pytest.mark.parametrize(("good", "bad", "words"), REFUSED, ids=[bad.split("\n")[-1] or bad for _, bad, _ in REFUSED])
def test_no_rig_file_talks_a_real_arm_out_of_its_rules(good: str, bad: str, words: str, tmp_path):
    path = tmp_path / "odd.toml"
    text = (RIGS / "xarm7.toml").read_text()
    path.write_text(re.sub(rf"(?m)^{re.escape(good)}", bad, text, count=1))
    assert path.read_text() != text
    with pytest.raises(ConfigError, match=words):
        load_rig(str(path))
