"""A plan's file: what it may say, and that what is wrong is refused by file, key, value and choices."""

from __future__ import annotations

from pathlib import Path

import pytest

from far_app.cli import main
from far_app.errors import ConfigError
from far_app.trial_plan.plan import chance
from tests.recording import sessions
from tests.trial_plan.plans import TWO, read

GOOD = 'task = "lift"\nseeds = [3, 4]\n' + TWO
REAL = 'task = "lift"\n' + TWO + '[[scene]]\nname = "left"\n'

BAD = {
    "an unknown method": (GOOD.replace('"nr"', '"hope"'), ["method[2].method is 'hope'", "one of: dp, nr, far"]),
    "an unknown task": (GOOD.replace("lift", "fold"), ["task is 'fold'", "lift", "stack"]),
    "no task": (GOOD.replace('task = "lift"', ""), ["task is None", "lift"]),
    "a negative seed": (GOOD.replace("[3, 4]", "[3, -4]"), ["seeds[2] is -4", "from 0 to"]),
    "a seed twice": (GOOD.replace("[3, 4]", "[3, 3]"), ["seeds says 'seed 3' twice"]),
    "seeds that are none": (GOOD.replace("[3, 4]", '"many"'), ["seeds is 'many'", "first = N, count = N"]),
    "a span without end": (GOOD.replace("[3, 4]", "{ count = 20000 }"), ["seeds.count is 20000", "from 1 to 10000"]),
    "repetitions beyond the limit": ("repetitions = 101\n" + GOOD, ["repetitions is 101", "from 1 to 100"]),
    "no repetitions": ("repetitions = 0\n" + GOOD, ["repetitions is 0", "from 1 to 100"]),
    "too many trials": (
        "repetitions = 100\n" + GOOD.replace("[3, 4]", "{ first = 0, count = 51 }"),
        ["repetitions is 100", "at most 10000 (it is 10200)"],
    ),
    "text for a number": ('repetitions = "two"\n' + GOOD, ["repetitions is 'two'", "a whole number"]),
    "true for a number": ("repetitions = true\n" + GOOD, ["repetitions is True", "a whole number"]),
    "an unknown key": ("blinded = true\n" + GOOD, ["blinded is not known here", "known: name, task"]),
    "an unknown key of a method": (
        GOOD.replace('method = "nr"', 'method = "nr"\nspeed = 2'), ["method[2].speed is not known here"],
    ),
    "one method": (GOOD.split("[[method]]\nname = \"theirs")[0], ["1 [[method]] tables", "at least 2"]),
    "a name twice": (GOOD.replace("theirs", "ours"), ["method[2].name says 'ours' twice"]),
    "a name no folder may have": ('name = "a/b"\n' + GOOD, ["name is 'a/b'", "letters, digits"]),
    "a checkpoint that is not there": (
        GOOD.replace('method = "nr"', 'method = "nr"\npolicy = "gone.safetensors"'),
        ["method[2].policy is 'gone.safetensors'", "a file that exists"],
    ),
    "an unknown setting": (
        GOOD.replace('method = "nr"', 'method = "nr"\nretry.fcpa = { speed = 2 }'),
        ["method[2].retry.fcpa: unknown setting speed", "known: objective"],
    ),
    "a setting out of range": (
        GOOD.replace('method = "nr"', 'method = "nr"\nretry.attribution = { rho = 120 }'), ["rho is 120", "(0, 100]"],
    ),
    "a real scene on the twin": (GOOD + '[[scene]]\nname = "left"\n', ["scene is 'given'", "its scenes are seeds"]),
    "no TOML": ("task = ", ["is no TOML file"]),
}  # fmt: skip

BAD_REAL = {
    "seeds on a real arm": ("seeds = [1]\n" + REAL, ["seeds is [1]", "[[scene]] tables"]),
    "no scene": ('task = "lift"\n' + TWO, ["no [[scene]] table"]),
    "a picture that is not there": (REAL + 'image = "gone.png"\n', ["scene[1].image is 'gone.png'", "a file that"]),
    "an unknown camera": (REAL + 'image = "here.png"\ncamera = "top"\n', ["scene[1].camera is 'top'", "front, wrist"]),
    "a camera without a picture": (REAL + 'camera = "front"\n', ["scene[1].camera is 'front'", "there is no image"]),
    "a recording that is not there": (REAL + 'recording = "gone"\n', ["scene[1].recording is 'gone'", "a folder that"]),
    "a trial it has not": (REAL + 'recording = "session"\ntrial = 9\n', ["scene[1].trial is 9", "holds an attempt"]),
    "a scene twice": (REAL + '[[scene]]\nname = "left"\n', ["scene[2].name says 'left' twice"]),
}


@pytest.mark.parametrize("what", BAD)
def test_what_is_wrong_is_refused_by_name(what: str, tmp_path: Path):
    text, expected = BAD[what]
    with pytest.raises(ConfigError) as refused:
        read(tmp_path, text)
    assert all(word in str(refused.value) for word in [str(tmp_path / "ab.toml"), *expected]), refused.value


@pytest.mark.parametrize("what", BAD_REAL)
def test_an_impossible_real_scene_is_refused_by_name(what: str, tmp_path: Path):
    text, expected = BAD_REAL[what]
    (tmp_path / "here.png").write_bytes(b"")
    (tmp_path / "session").mkdir()
    with pytest.raises(ConfigError) as refused:
        read(tmp_path, text, "xarm", ("front", "wrist"))
    assert all(word in str(refused.value) for word in [str(tmp_path / "ab.toml"), *expected]), refused.value


def test_a_rig_without_cameras_can_show_no_picture(tmp_path: Path):
    (tmp_path / "here.png").write_bytes(b"")
    with pytest.raises(ConfigError, match=r"camera is None.*the rig has no cameras"):
        read(tmp_path, REAL + 'image = "here.png"\n', "xarm")


def test_a_plan_that_is_refused_begins_nothing(tmp_path: Path, capsys):
    file = tmp_path / "ab.toml"
    file.write_text(GOOD.replace('"nr"', '"hope"'))
    assert main(["trials", str(file), "--headless", "--recordings", str(tmp_path / "r")]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert str(file) in line and "method[2].method is 'hope'" in line and "negative-guidance" in line
    assert not (tmp_path / "r").exists()


def test_what_is_not_said_has_its_usual_value(tmp_path: Path):
    plan = read(tmp_path, GOOD.replace("[3, 4]", "{ first = 1000, count = 3 }"))
    assert [s.seed for s in plan.scenes] == [1000, 1001, 1002] and plan.name == "ab" and plan.trials == 6
    assert not plan.blind and plan.repetitions == 1 and plan.max_attempts is None


def test_a_scene_looks_as_a_recorded_trial_began(tmp_path: Path):
    folder = sessions.small_session(tmp_path, steps=3)
    plan = read(tmp_path, REAL + f'recording = "{folder.name}"\n', "xarm", ("front",))
    assert plan.scenes[0].recording == folder and plan.scenes[0].trial == 1


def test_a_repetition_is_the_same_scene_with_other_draws(tmp_path: Path):
    scene = read(tmp_path, GOOD).scenes[0]
    assert chance(scene, 1) == scene.seed and len({chance(scene, r) for r in range(1, 101)}) == 100
