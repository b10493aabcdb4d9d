"""Demonstrations on disk (robomimic's HDF5 layout) and in memory.

data/demo_N                 attrs: num_samples, seed, success
    actions (N, 7)   rewards (N,)   dones (N,)
    obs/front_image, obs/wrist_image (N, S, S, 3) uint8
    obs/robot0_eef_pos (N, 3)  obs/robot0_eef_quat (N, 4) xyzw  obs/robot0_gripper (N, 1)  obs/object (N, K)
data attrs: total, env_args (JSON with env_name, type, env_kwargs, and setup: far_app/preflight.py)

Pictures of S × S pixels, the policy's size, are what a policy saw. Others (datasets made elsewhere) are whole frames,
and become pictures by the very function that frames live ones (far_app/picture.py).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Bool, Float, UInt8

from far_app.errors import ConfigError, RecordingError
from far_app.picture import Framing, seen
from far_app.types import Attempt, Observation


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One demonstration or rollout as arrays, N ticks."""

    images: dict[str, UInt8[np.ndarray, "N S S 3"]]
    states: Float[np.ndarray, "N 8"]
    """End-effector position, quaternion (xyzw), gripper opening."""
    actions: Float[np.ndarray, "N 7"]
    rewards: Float[np.ndarray, "N"]
    """The task's shaped reward in [0, 1] at each tick."""
    successes: Bool[np.ndarray, "N"]
    """The task's own check at each tick."""
    success: bool
    seed: int
    objects: Float[np.ndarray, "N K"] | None = None
    """Position and quaternion of each object, base frame, where the demonstrations know them (the twin's do)."""

    def __len__(self) -> int:
        return len(self.actions)


def write_episode(path: Path, episode: Episode, env_args: dict[str, object]) -> None:
    """Append one demonstration to a file (made on first use)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "a") as file:
        data = file.require_group("data")
        data.attrs["env_args"] = json.dumps(env_args)
        group = data.create_group(f"demo_{len(data)}")
        group.attrs.update({"num_samples": len(episode), "seed": episode.seed, "success": episode.success})
        group["actions"] = episode.actions.astype(np.float32)
        group["rewards"] = episode.rewards.astype(np.float32)
        group["dones"] = episode.successes.astype(np.int8)
        obs = group.create_group("obs")
        for camera, frames in episode.images.items():
            obs.create_dataset(f"{camera}_image", data=frames, chunks=(1, *frames.shape[1:]), compression="lzf")
        obs["robot0_eef_pos"] = episode.states[:, :3]
        obs["robot0_eef_quat"] = episode.states[:, 3:7]
        obs["robot0_gripper"] = episode.states[:, 7:]
        if episode.objects is not None:
            obs["object"] = episode.objects.astype(np.float32)
        data.attrs["total"] = int(data.attrs.get("total", 0)) + len(episode)


def count_episodes(path: Path) -> int:
    """Demonstrations already in a file; 0 when there is none."""
    if not path.exists():
        return 0
    with h5py.File(path, "r") as file:
        return len(file["data"]) if "data" in file else 0


def episode_count(path: Path, limit: int | None) -> int:
    """How many of a file's demonstrations a limit leaves."""
    return min(count_episodes(path), limit if limit is not None else count_episodes(path))


def check_origin(path: Path, env_args: dict[str, object]) -> None:
    """ConfigError when a file holds episodes of another environment or another arm."""
    if not path.exists():
        return
    with h5py.File(path, "r") as file:
        raw = file["data"].attrs.get("env_args") if "data" in file else None
    there = json.loads(raw) if raw else env_args

    def origin(args: dict[str, Any]) -> tuple[str, str]:
        return str(args.get("env_name")), str(args.get("env_kwargs", {}).get("robots")).lower()

    if origin(there) != origin(env_args):
        raise ConfigError(
            f"{path} holds episodes of {' on '.join(origin(there))}, these would be of "
            f"{' on '.join(origin(env_args))}; give another --out"
        )


def last_scene(path: Path) -> int:
    """How many scenes a file has used, relative to its first one; 0 when there is no file."""
    scenes = scenes_in(path)
    return max(scenes) - min(scenes) + 1 if scenes else 0


def read_setup(path: Path) -> dict[str, Any] | None:
    """What a file says of the robot its episodes come from; None where it says nothing."""
    if not path.exists():
        return None
    with h5py.File(path, "r") as file:
        raw = file["data"].attrs.get("env_args") if "data" in file else None
    return json.loads(raw).get("setup") if raw else None


def pictures(frames: Any, size: int | None, framing: Framing) -> UInt8[np.ndarray, "N S S 3"]:
    """A dataset's stored frames as a policy of that picture size sees them; as they are without a size."""
    if size is None or frames.shape[1:3] == (size, size):
        return frames[:]
    return np.stack([seen(frame, framing, size) for frame in frames])


def read_episodes(
    path: Path,
    cameras: tuple[str, ...],
    limit: int | None = None,
    size: int | None = None,
    framings: Mapping[str, Framing] | None = None,
    first: int = 0,
) -> list[Episode]:
    """`limit` demonstrations from the `first` on, decoded, their pictures of `size` pixels; `framings`: how the whole
    frames of the cameras are cut, where that is what the file holds."""
    if not path.exists():
        raise RecordingError(f"no demonstrations at {path}; make some with `far demo`")
    episodes = []
    with h5py.File(path, "r") as file:
        names = sorted(file["data"], key=lambda name: int(name.removeprefix("demo_")))[first:][:limit]
        for name in names:
            group = file["data"][name]
            missing = [c for c in cameras if f"{c}_image" not in group["obs"]]
            if missing:
                raise RecordingError(
                    f"{path}:{name} has no images of {', '.join(missing)}; it has {list(group['obs'])}"
                )
            states = np.concatenate(
                [group["obs"][k][:] for k in ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper")], axis=1
            )
            episodes.append(Episode(
                images={c: pictures(group["obs"][f"{c}_image"], size, (framings or {}).get(c, Framing()))
                        for c in cameras},
                states=states.astype(np.float32),
                actions=group["actions"][:], rewards=group["rewards"][:], successes=group["dones"][:].astype(bool),
                success=bool(group.attrs["success"]), seed=int(group.attrs["seed"]),
                objects=group["obs"]["object"][:] if "object" in group["obs"] else None,
            ))  # fmt: skip
    return episodes


def episode_of(observations: list[Observation], actions: list[np.ndarray], success: bool, seed: int) -> Episode:
    """Arrays of what was seen and done: one observation for each action."""
    cameras = tuple(observations[0].images)
    states = [np.concatenate([o.eef.position, o.eef.quaternion, [o.gripper]]) for o in observations]
    return Episode(
        images={c: np.stack([o.images[c] for o in observations]) for c in cameras},
        states=np.stack(states).astype(np.float32), actions=np.stack(actions).astype(np.float32),
        rewards=np.array([o.reward for o in observations], np.float32),
        successes=np.array([bool(o.success) for o in observations]), success=success, seed=seed,
        objects=np.array([np.concatenate([[*p.position, *p.quaternion] for p in o.objects.values()])
                          for o in observations]) if observations[0].objects else None,
    )  # fmt: skip


def seen_and_done(attempt: Attempt) -> tuple[list[Observation], list[np.ndarray]]:
    """An attempt as `episode_of` takes it: what was seen, and the actions as sent to the arm."""
    actions = [s.sent if np.isfinite(s.sent).all() else s.commanded for s in attempt.steps]
    return [*(s.observation for s in attempt.steps), attempt.final], [*actions, actions[-1]]


def scenes_in(path: Path) -> set[int]:
    """The scenes of a file's episodes; none when there is no file."""
    if not path.exists():
        return set()
    with h5py.File(path, "r") as file:
        return {int(group.attrs["seed"]) for group in file["data"].values()} if "data" in file else set()
