"""A rig's file, and what its stations change in it."""

import dataclasses

import numpy as np
import pytest

from far_app.errors import ConfigError
from far_app.tasks import TASKS
from hw.rig import RIGS, laid_over, load_rig
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
