"""Every task of the paper on its own arm: seeded scenes, an expert who solves them within the horizon."""

import numpy as np
import pytest

from far_app.demonstrations import demonstrate
from far_app.motion import rotation_between
from far_app.tasks import TASKS, at_pace, task
from hw.lockstep import LockstepRobot
from hw.rig import load_rig
from hw.twin import TwinPlant

PANDA = load_rig("panda")


@pytest.mark.parametrize(
    ("name", "panda", "xarm7"),
    [("lift", 100, 150), ("stack", 150, 675), ("door", 200, 900), ("bread", 200, 900), ("can", 200, 300),
     ("square", 200, 300)],
)  # fmt: skip
def test_the_paper_s_horizons_are_kept_in_ticks_and_in_seconds(name, panda, xarm7):
    ours, real = task(name, "panda"), task(name, "xarm7")
    assert (ours.horizon, real.horizon) == (panda, xarm7)
    assert ours.horizon / ours.rate == pytest.approx(real.horizon / real.rate)
    assert ours.rate * ours.repeat == pytest.approx(20.0)
    assert real.rate == 30.0 and real.repeat == 1
    assert at_pace(TASKS[name], "panda") == ours


def test_a_repeated_action_goes_as_far_as_its_repetitions():
    assert PANDA.scale_for(task("stack", "panda")).translation == pytest.approx(3 * PANDA.scale.translation)
    assert PANDA.scale_for(task("lift", "panda")) == PANDA.scale


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(TASKS))
def test_the_expert_solves_the_task_and_the_same_seed_gives_the_same_scene(name):
    entry = task(name, "panda")
    plant = TwinPlant(PANDA, entry)
    first = plant.measure()
    assert first.eef.position == pytest.approx(PANDA.start_position, abs=0.01)
    assert np.linalg.norm(rotation_between(np.array(PANDA.start_quaternion), first.eef.quaternion)) < 0.03

    def scene(seed: int) -> np.ndarray:
        plant.reset(seed)
        return np.concatenate([p.position for p in plant.measure().objects.values()])

    assert np.array_equal(scene(3), scene(3))
    assert not np.allclose(scene(3), scene(4), atol=1e-3)
    robot = LockstepRobot(plant, None, PANDA, entry)
    runs = [demonstrate(robot, robot.advance, entry, robot.scale, 1_500_000 + i) for i in range(3)]
    assert all(success for _, _, success in runs)
    assert {tuple(o.objects) for seen, _, _ in runs for o in seen} == {tuple(n for n, _ in entry.objects)}
