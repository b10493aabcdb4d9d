"""Values for the recorder's tests: attempts like the twin's, and equality of whole values."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from far_app.types import (
    TICK_STAGES,
    Ack,
    ActionChunk,
    Adaptation,
    AdaptationStep,
    Attempt,
    Judge,
    Observation,
    Outcome,
    Pose,
    RobotMode,
    RobotStatus,
    Step,
    TickTimes,
)

CAMERAS = ("front", "wrist")


def frame(number: int, camera: str, size: int = 84) -> np.ndarray:
    """A picture that says which one it is: a moving square on a shaded ground."""
    y, x = np.mgrid[0:size, 0:size]
    image = np.stack([x * 2, y * 2, np.full_like(x, 60 if camera == "front" else 160)], axis=-1).astype(np.uint8)
    left = (number * 3) % (size - 12)
    image[20:32, left : left + 12] = (200, number % 256, 30)
    return image


def pose(x: float) -> Pose:
    return Pose(position=np.array([x, 0.1, 0.3]), quaternion=np.array([1.0, 0.0, 0.0, 0.0]))


def observation(number: int, stamp: float, *, cameras: tuple[str, ...] = CAMERAS, size: int = 84) -> Observation:
    ack = Ack(seq=number, accepted=stamp - 0.001, due=stamp - 0.002, pose=pose(number * 0.001), gripper=-1.0)
    return Observation(
        seq=number, stamp=stamp, eef=pose(number * 0.001), gripper=0.8, joints=np.linspace(-1, 1, 7) + number * 1e-3,
        images={camera: frame(number, camera, size) for camera in cameras},
        status=RobotStatus(mode=RobotMode.TRACKING, clips=number, scene_seed=7), acks=(ack,) if number else (),
        objects={"cube": pose(0.4)}, success=False, reward=0.25,
    )  # fmt: skip


def step(tick: int, start: float = 1000.0, **changes: Any) -> Step:
    stamp = start + tick / 30
    action = np.sin(np.arange(7) + tick)
    delta = np.zeros(7)
    values: dict[str, Any] = dict(
        tick=tick, seq=tick + 1, stamp=stamp, deadline=stamp + 0.01, observation=observation(tick, stamp),
        action=action, perturbation=delta, commanded=np.clip(action + delta, -1, 1), sent=action * 0.99,
        chunk_tick=tick - 1, starved=False, policy_version="base", value=-1.0 + tick / 300, reward=0.25, success=False,
        lateness=0.0004,
    )  # fmt: skip
    return Step(**{**values, **changes})


def chunk(tick: int, *, candidates: int = 0) -> ActionChunk:
    rng = np.random.default_rng(tick)
    return ActionChunk(
        tick=tick, actions=rng.uniform(-1, 1, (8, 7)), policy_version="base", value=-0.5,
        candidates=rng.uniform(-1, 1, (candidates, 8, 7)).astype(np.float32) if candidates else None,
    )  # fmt: skip


def tick_times(tick: int, start: float = 1000.0) -> TickTimes:
    spent = {stage: (tick + 1) * 1e-6 * (i + 1) for i, stage in enumerate(TICK_STAGES)}
    return TickTimes(tick=tick, stamp=start + tick / 30, **spent)


def attempt(index: int, steps: int, start: float = 1000.0, success: bool = False) -> Attempt:
    outcome = Outcome(success=success, judged_by=Judge.TWIN if success else Judge.HORIZON)
    return Attempt(
        index=index, scene_seed=7, steps=tuple(step(t, start) for t in range(steps)),
        final=observation(steps, start + steps / 30), outcome=outcome, policy_version="base",
    )  # fmt: skip


def adaptation(ticks: int) -> Adaptation:
    values = np.linspace(-1, -0.2, ticks + 1)
    history = tuple(
        AdaptationStep(step=k, steps=10, loss=0.7 - k / 100, winner_error=2.0, loser_error=3.0 + k) for k in range(10)
    )
    return Adaptation(
        status="adapted", base_version="base", version="base+1", values=values, value_changes=values[8:] - values[:-8],
        threshold=0.02, flagged=(3, 4, 5), pairs=24, empty_states=1, history=history,
        seconds={"attribution": 0.01, "candidates": 0.8, "update": 3.2}, note="",
    )  # fmt: skip


def same(a: Any, b: Any) -> bool:
    """Whether two values hold the same: arrays by content (NaN equals NaN), mappings by key, numbers exactly."""
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return np.shape(a) == np.shape(b) and np.array_equal(a, b, equal_nan=np.asarray(a).dtype.kind == "f")
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, Mapping):
        return set(a) == set(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, float) and isinstance(b, float) and np.isnan(a):
        return bool(np.isnan(b))
    return type(a) is type(b) and a == b
