"""The state preset sees the same numbers live and in training."""

import numpy as np
import pytest
import torch

from far_app.errors import ConfigError
from far_app.learning.dataset import Episode
from far_app.learning.policy import DiffusionPolicy, preset
from far_app.learning.runtime import ActingPolicy
from far_app.learning.state import OBJECT, PROPRIOCEPTION, state_of, states_of
from far_app.motion import quat_from_rotvec
from far_app.types import Observation, Pose, RobotMode, RobotStatus


def observation(rng: np.random.Generator) -> Observation:
    def pose() -> Pose:
        return Pose(position=rng.normal(size=3), quaternion=quat_from_rotvec(rng.normal(size=3)))

    return Observation(
        seq=0, stamp=0.0, eef=pose(), gripper=0.4, joints=np.zeros(7), status=RobotStatus(mode=RobotMode.TRACKING),
        objects={"a": pose(), "b": pose()},
    )  # fmt: skip


def episode(seen: list[Observation], objects: bool = True) -> Episode:
    own = [np.concatenate([o.eef.position, o.eef.quaternion, [o.gripper]]) for o in seen]
    poses = [np.concatenate([[*p.position, *p.quaternion] for p in o.objects.values()]) for o in seen]
    return Episode(
        images={}, states=np.stack(own).astype(np.float32), actions=np.zeros((len(seen), 7), np.float32),
        rewards=np.zeros(len(seen)), successes=np.zeros(len(seen), bool), success=False, seed=0,
        objects=np.stack(poses) if objects else None,
    )  # fmt: skip


def test_live_and_recorded_states_are_the_same():
    rng = np.random.default_rng(0)
    seen = [observation(rng) for _ in range(5)]
    live = np.stack([state_of(o, ("a", "b")) for o in seen])
    assert live.shape == (5, PROPRIOCEPTION + 2 * OBJECT)
    assert np.allclose(live, states_of(episode(seen), ("a", "b")), atol=1e-6)
    assert np.array_equal(states_of(episode(seen), ()), live[:, :PROPRIOCEPTION])


def test_an_object_is_where_it_is_where_it_is_from_the_hand_and_how_it_is_turned():
    seen = observation(np.random.default_rng(1))
    quarter = Pose(position=np.array((1.0, 2.0, 3.0)), quaternion=quat_from_rotvec(np.array((0, 0, np.pi / 2))))
    state = state_of(Observation(**{**vars(seen), "objects": {"a": quarter}}), ("a",))[PROPRIOCEPTION:]
    assert np.allclose(state[:3], (1, 2, 3))
    assert np.allclose(state[3:6], np.array((1, 2, 3)) - seen.eef.position, atol=1e-6)
    assert np.allclose(state[6:], (0, 1, 0, -1, 0, 0), atol=1e-6), "where its x and y axes point"


def test_demonstrations_without_objects_say_so():
    with pytest.raises(ConfigError, match="know the poses of no objects, the policy sees a"):
        states_of(episode([observation(np.random.default_rng(2))], objects=False), ("a",))


def test_a_chunk_does_not_depend_on_what_it_is_planned_beside():
    """Bit by bit: comparisons of methods rest on it."""
    torch.manual_seed(0)
    network = DiffusionPolicy(preset("state", "stack")).eval().requires_grad_(False)
    rng = np.random.default_rng(3)
    seen = [observation(rng) for _ in range(5)]
    seen = [Observation(**{**vars(o), "objects": dict(zip(("cubeA", "cubeB"), o.objects.values(), strict=True))})
            for o in seen]  # fmt: skip
    noise = rng.standard_normal((5, 8, 7), dtype=np.float32)
    for engine in ("torch", "auto"):
        acting = ActingPolicy(network, "base", None, engine, batch=4)
        together = acting.plan([(o, o) for o in seen], range(5), noise)
        for i in (0, 2, 4):
            (alone,) = acting.plan([(seen[i], seen[i])], [i], noise[i : i + 1])
            assert np.array_equal(alone.actions, together[i].actions)
        backwards = acting.plan([(o, o) for o in seen[::-1]], range(5), noise[::-1])
        assert all(np.array_equal(a.actions, b.actions) for a, b in zip(together, backwards[::-1], strict=True))
